"""A client of OPC UA on asyncua: does what is written to it as lines of JSON, and prints what it finds as such.

    opcua_client.py URL
"""

import asyncio
import json
import sys

from asyncua import Client, ua
from asyncua.common.events import get_filter_from_event_type

OWN = "urn:regrind:live"
PACKML = "http://opcfoundation.org/UA/PackML/"


def say(**fields):
    print(json.dumps(fields, default=str), flush=True)


def plain(value):
    if isinstance(value, ua.LocalizedText):
        return value.Text
    if isinstance(value, ua.NodeId):
        return value.to_string()
    if isinstance(value, ua.EUInformation):
        return {"unit": value.DisplayName.Text, "id": value.UnitId}
    return value


def told(data):
    return {"value": plain(data.Value.Value), "status": data.StatusCode.name, "type": data.Value.VariantType.name,
            "when": str(data.SourceTimestamp)}


class Looks:
    def __init__(self, names):
        self.names = names

    def datachange_notification(self, node, _value, data):
        say(changed=self.names[node.nodeid], **told(data.monitored_item.Value))

    def event_notification(self, event):
        fields = {name: plain(value) for name, value in vars(event).items() if not name.startswith("_")}
        say(event=fields)

    def status_change_notification(self, status):
        say(subscription=str(status))


def of_type(kind):
    """Chooses the events of a kind, and of all kinds of it. A list of kinds, which asyncua would write, the server takes for none."""
    element = ua.ContentFilterElement(FilterOperator=ua.FilterOperator.OfType)
    element.FilterOperands.append(ua.LiteralOperand(Value=ua.Variant(kind)))
    return ua.ContentFilter(Elements=[element])


async def walk(node, path, found):
    """All that is below a node, with what may be done with it."""
    for child in await node.get_children():
        name = (await child.read_browse_name()).Name
        below = f"{path}/{name}"
        kind = (await child.read_node_class()).name
        entry = {"path": below, "class": kind, "node": child.nodeid.to_string()}
        if kind == "Variable":
            entry["access"] = sorted(bit.name for bit in await child.get_access_level())
            entry["user_access"] = sorted(bit.name for bit in await child.get_user_access_level())
        definition = await child.read_type_definition()
        entry["definition"] = definition.to_string() if definition else None
        found.append(entry)
        await walk(child, below, found)


async def does(client, order, state):
    own = state["own"]
    node = lambda name: client.get_node(ua.NodeId(name, own))
    if "read" in order:
        found = {name: told(await node(name).read_data_value(raise_on_bad_status=False)) for name in order["read"]}
        say(read=found)
    elif "browse" in order:
        packml = await client.get_namespace_index(PACKML)
        objects = await client.nodes.objects.get_child(f"{packml}:PackMLObjects")
        found = []
        await walk(objects, "", found)
        say(browse=found, packml=packml, own=own)
    elif "subscribe" in order:
        nodes = [node(name) for name in order["subscribe"]]
        looks = Looks({found.nodeid: name for found, name in zip(nodes, order["subscribe"])})
        state["subscription"] = await client.create_subscription(100, looks)
        await state["subscription"].subscribe_data_change(nodes)
        kinds = [node(kind) for kind in ("CycleResultEventType", "CellAlarmEventType", "RunEndedEventType")]
        source = node(order["events"]) if order["events"] else client.nodes.server
        chosen = await get_filter_from_event_type(kinds)
        chosen.WhereClause = of_type(node("CellEventType").nodeid)
        await state["subscription"].subscribe_events(source, kinds, chosen, queuesize=100)
        say(subscribed=True)
    elif "write" in order:
        try:
            kind = ua.VariantType[order["type"]]
            await node(order["write"]).write_value(ua.DataValue(ua.Variant(order["value"], kind)))
            say(write=order["write"], result="Good")
        except ua.UaStatusCodeError as error:
            say(write=order["write"], result=type(error).__name__)
    elif "call" in order:
        try:
            await node("Cell").call_method(ua.NodeId(order["call"], own))
            say(call=order["call"], result="Good")
        except ua.UaStatusCodeError as error:
            say(call=order["call"], result=type(error).__name__)


async def orders(client, state):
    loop = asyncio.get_running_loop()
    while line := await loop.run_in_executor(None, sys.stdin.readline):
        await does(client, json.loads(line), state)


async def stands(client):
    while True:
        await client.check_connection()
        await asyncio.sleep(0.1)


async def main():
    client = Client(sys.argv[1])
    async with client:
        state = {"own": await client.get_namespace_index(OWN)}
        say(connected=True)
        work = asyncio.create_task(orders(client, state))
        watch = asyncio.create_task(stands(client))
        done, _ = await asyncio.wait({work, watch}, return_when=asyncio.FIRST_COMPLETED)
        say(lost=True) if watch in done else work.result()


try:
    asyncio.run(main())
except Exception as error:  # A connection that has gone is told above; what comes of leaving it is no news.
    say(ended=repr(error))
