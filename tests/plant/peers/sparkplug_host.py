"""A host of Sparkplug B on pysparkplug: prints what it hears as lines of JSON, and sends the commands that are written to it.

It keeps account as a host does: of what is alive, of the numbers in a row, of which birth a death belongs to, and of the order of the times of
present and of historical values. What does not fit is printed as a fault. `metrics` are the present values, `history` the historical ones.

{"state": {"host": ID, "online": true, "timestamp": MS}} publishes the state of a primary host.

    sparkplug_host.py PORT GROUP NODE [CERTIFICATES USER PASSWORD]
"""

import json
import sys
import threading

from pysparkplug import (Client, ClientOptions, DataType, DCmd, Message, MessageType, Metric, NCmd, QoS, TLSConfig, Topic,
                         get_current_timestamp)
from pysparkplug._protobuf import Payload

printing = threading.Lock()


def say(**fields):
    with printing:
        print(json.dumps(fields), flush=True)


class Account:
    """What a host knows of a node."""

    def __init__(self):
        self.birth = None
        self.sequence = None
        self.times = {}

    def in_order(self, name, historical, when):
        """The values of a metric come in the order of their times: the present ones, and those of the history of a session."""
        last = self.times.get((name, historical), 0)
        if when is None or when < last:
            say(fault=f"{name} of {when} behind that of {last}, history {historical}")
        self.times[name, historical] = when or last

    def take(self, kind, payload, metrics):
        if kind == "NBIRTH":
            if payload.seq != 0:
                say(fault=f"a birth with the number {payload.seq}")
            self.birth, self.sequence, self.times = metrics.get("bdSeq"), 0, {}
        elif kind == "NDATA":
            if self.birth is None:
                say(fault="data of a node that is not alive")
            elif payload.seq != (self.sequence + 1) % 256:
                say(fault=f"number {payload.seq} behind {self.sequence}")
            self.sequence = payload.seq
        elif kind == "NDEATH":
            if self.birth is not None and metrics.get("bdSeq") != self.birth:
                say(fault=f"the death of {metrics.get('bdSeq')}, not of {self.birth}")
            self.birth = None


class Host(Client):
    account = Account()

    def _handle_message(self, mqtt_message):
        message = super()._handle_message(mqtt_message)
        kind = message.topic.message_type.value
        found = [message.payload.bd_seq_metric] if kind == "NDEATH" else message.payload.metrics
        metrics = {metric.name: metric.value for metric in found if not metric.is_historical}
        history = {metric.name: metric.value for metric in found if metric.is_historical}
        times = {metric.name: metric.timestamp for metric in found}
        self.account.take(kind, message.payload, metrics)
        if history and kind != "NDATA":
            say(fault=f"history in {kind}")
        # The broker keeps a death since the begin of the connection.
        for metric in found if kind != "NDEATH" else []:
            self.account.in_order(metric.name, metric.is_historical, metric.timestamp)
        raw = Payload.FromString(mqtt_message.payload)
        units = {metric.name: value.string_value for metric in raw.metrics
                 for key, value in zip(metric.properties.keys, metric.properties.values) if key == "engUnit"}
        nulls = [metric.name for metric in raw.metrics if metric.is_null]
        unsaid = [metric.name for metric in raw.metrics if not metric.is_null and metric.WhichOneof("value") is None]
        if unsaid:
            say(fault=f"neither a value nor none: {unsaid}")
        say(heard=kind, seq=getattr(message.payload, "seq", None), metrics=metrics, history=history, times=times, units=units, nulls=nulls,
            qos=int(message.qos), sent=message.payload.timestamp,
            types={metric.name: metric.datatype.name for metric in found}, retained=bool(message.retain))
        return message


def main():
    port, group, node, *safe = sys.argv[1:]
    options = ClientOptions(reconnection_delay_min=1, reconnection_delay_max=1)
    proof = {}
    if safe:
        proof = {"transport_config": TLSConfig(ca_certs=safe[0]), "username": safe[1], "password": safe[2]}
    host = Host(client_id="host", client_options=options, **proof)
    subscribed = []

    def on_subscribe(*_):
        subscribed.append(True)
        if len(subscribed) % 3 == 0:
            say(listens=True)

    host._client.on_subscribe = on_subscribe
    host._client.on_disconnect = lambda *_: say(cut=True)
    for kind in (MessageType.NBIRTH, MessageType.NDATA, MessageType.NDEATH):
        host.subscribe(Topic(group_id=group, message_type=kind, edge_node_id=node), QoS.AT_LEAST_ONCE, lambda *_: None)
    host.connect("localhost", port=int(port), keepalive=5)
    for line in sys.stdin:
        order = json.loads(line)
        if "state" in order:
            state = order["state"]
            host._client.publish(f"spBv1.0/STATE/{state.pop('host')}", json.dumps(state), qos=1, retain=True)
            continue
        if "raw" in order:
            host._client.publish(f"spBv1.0/{group}/NCMD/{node}", bytes.fromhex(order["raw"]), qos=1)
            continue
        metric = Metric(timestamp=get_current_timestamp(), name=order["name"], datatype=DataType[order["type"]], value=order["value"])
        device = order.get("device")
        kind, command = (MessageType.DCMD, DCmd) if device else (MessageType.NCMD, NCmd)
        topic = Topic(group_id=group, message_type=kind, edge_node_id=node, device_id=device)
        payload = command(timestamp=get_current_timestamp(), metrics=(metric,))
        host.publish(Message(topic=topic, payload=payload, qos=QoS.AT_LEAST_ONCE, retain=False), include_dtypes=True)


main()
