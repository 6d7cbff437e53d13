"""A client of OPC UA on asyncua: does what is written to it as lines of JSON, and prints what it finds as such.

    opcua_client.py URL
"""

import asyncio
import json
import sys
from datetime import datetime, timezone

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


def seconds(time):
    """A time as seconds since 1970, as the clock of this client counts them."""
    return time.replace(tzinfo=time.tzinfo or timezone.utc).timestamp() if time else None


def now():
    return datetime.now(timezone.utc).timestamp()


def told(data):
    value = data.Value.Value
    if isinstance(value, ua.ServerStatusDataType):
        value = value.CurrentTime
    if isinstance(value, datetime):
        value = seconds(value)
    return {"value": plain(value), "status": data.StatusCode.name, "type": data.Value.VariantType.name,
            "source": seconds(data.SourceTimestamp), "server": seconds(data.ServerTimestamp)}


async def with_both_times(client, nodes):
    """What the nodes have. asyncua by itself asks for the time of the source alone."""
    wanted = ua.ReadParameters(TimestampsToReturn=ua.TimestampsToReturn.Both)
    for node in nodes:
        wanted.NodesToRead.append(ua.ReadValueId(NodeId=node.nodeid, AttributeId=ua.AttributeIds.Value))
    return await client.uaclient.read(wanted)


# Variables of every server that have the present time.
CLOCK = {"CurrentTime": ua.NodeId(ua.ObjectIds.Server_ServerStatus_CurrentTime), "ServerStatus": ua.NodeId(ua.ObjectIds.Server_ServerStatus)}


class Looks:
    def __init__(self, names):
        self.names = names

    def datachange_notification(self, node, _value, data):
        say(changed=self.names[node.nodeid], received=now(), **told(data.monitored_item.Value))

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
    # A name is a node of the cell; "ns=..." and "i=..." are others.
    node = lambda name: client.get_node(name if name.startswith(("ns=", "i=")) else ua.NodeId(name, own))
    if "read" in order:
        before = now()
        values = await with_both_times(client, [node(name) for name in order["read"]])
        say(read={name: told(value) for name, value in zip(order["read"], values)}, before=before, after=now())
    elif "clock" in order:
        looks = Looks({place: name for name, place in CLOCK.items()})
        state["clock"] = await client.create_subscription(100, looks)
        began = now()
        await state["clock"].subscribe_data_change([client.get_node(place) for place in CLOCK.values()])
        say(clock=True, began=began)
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
            await node(order.get("of", "Cell")).call_method(node(order["call"]).nodeid, *order.get("with", []))
            say(call=order["call"], result="Good")
        except ua.UaStatusCodeError as error:
            say(call=order["call"], result=type(error).__name__)
    elif "add" in order:
        try:
            await node("Cell").add_variable(ua.NodeId(order["add"], own), order["add"], 1.0)
            say(add=order["add"], result="Good")
        except ua.UaStatusCodeError as error:
            say(add=order["add"], result=type(error).__name__)
    elif "delete" in order:
        found = await client.delete_nodes([node(order["delete"])])
        say(delete=order["delete"], result=[code.name for code in found[1]])


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
