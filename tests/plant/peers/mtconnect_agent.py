"""The end of an agent on an adapter of MTConnect: prints what the adapter sends as lines of JSON.

It reads the devices file, and judges types, units and values by pymtconnect, which is generated from the model of the standard. It splits the lines
of SHDR as the agent of the standard's authors does: fields between bars, without the blanks around them. What does not fit is printed as a fault.

{"send": "..."} sends a line to the adapter.

    mtconnect_agent.py PORT DEVICES_FILE
"""

import importlib
import json
import re
import socket
import sys
import threading
from xml.etree import ElementTree

from pymtconnect.Enums.DataTypes.ConditionEnum import ConditionEnum
from pymtconnect.Enums.DataTypes.ConditionStateEnum import ConditionStateEnum
from pymtconnect.Enums.DataTypes.DataItemSubTypeEnum import DataItemSubTypeEnum
from pymtconnect.Enums.DataTypes.EventEnum import EventEnum
from pymtconnect.Enums.DataTypes.SampleEnum import SampleEnum
from pymtconnect.Enums.DataTypes.UnitEnum import UnitEnum

NAMESPACE = "{urn:mtconnect.org:MTConnectDevices:2.0}"
TYPES = {"EVENT": EventEnum, "SAMPLE": SampleEnum, "CONDITION": ConditionEnum}
TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?Z$")
printing = threading.Lock()


def say(**fields):
    with printing:
        print(json.dumps(fields), flush=True)


def pascal(name):
    return "".join(word.title() for word in name.split("_"))


def values_of(kind):
    """The controlled vocabulary of an event; None if it has none."""
    try:
        module = importlib.import_module(f"pymtconnect.Enums.DataTypes.{pascal(kind)}Enum")
    except ModuleNotFoundError:
        return None
    return {member.value for member in getattr(module, f"{pascal(kind)}Enum")}


def read_devices(path):
    root = ElementTree.parse(path).getroot()
    assert root.tag == NAMESPACE + "MTConnectDevices", root.tag
    ids = [element.get("id") for element in root.iter() if element.get("id")]
    for double in {one for one in ids if ids.count(one) > 1}:
        say(fault=f"{double} is the id of two elements")
    for components in root.iter(NAMESPACE + "Components"):
        for component in components:
            importlib.import_module(f"pymtconnect.Classes.ComponentTypes.{component.tag.removeprefix(NAMESPACE)}")
    items = {}
    for item in root.iter(NAMESPACE + "DataItem"):
        category, kind, sub_type, units = (item.get(key) for key in ["category", "type", "subType", "units"])
        for value, allowed in [(kind, TYPES[category]), (sub_type, DataItemSubTypeEnum), (units, UnitEnum)]:
            if value is not None and value not in {member.value for member in allowed}:
                say(fault=f"{value} of {item.attrib} is not in {allowed.__name__}")
        if category == "SAMPLE" and units is None:
            say(fault=f"{item.attrib} has no units")
        items[item.get("name")] = (category, kind)
    return items


def take(line, items):
    fields = [field.strip() for field in line.split("|")]
    if not TIME.match(fields[0]) or any(field.startswith('"') for field in fields):
        return say(fault=f"not a line of SHDR: {line!r}")
    key, rest = fields[1], fields[2:]
    if key not in items:
        return say(fault=f"{key} is not in the devices file")
    category, kind = items[key]
    count = 5 if category == "CONDITION" else 2 if kind == "MESSAGE" else 1
    if len(rest) != count:
        return say(fault=f"{len(rest)} fields instead of {count}: {line!r}")
    value = rest[0] if category == "CONDITION" else rest[-1]
    known = value != "UNAVAILABLE"
    if category == "CONDITION" and known and value not in {member.value for member in ConditionStateEnum}:
        say(fault=f"{value} is not the level of a condition")
    vocabulary = values_of(kind) if category == "EVENT" else None
    if known and vocabulary is not None and value not in vocabulary:
        say(fault=f"{value} is not a value of {kind}")
    if category == "SAMPLE" and known:
        float(value)
    say(time=fields[0], key=key, value=value, fields=rest)


items = read_devices(sys.argv[2])
say(items=sorted(items))
connection = socket.create_connection(("127.0.0.1", int(sys.argv[1])))


def send():
    for line in sys.stdin:
        connection.sendall(json.loads(line)["send"].encode())


threading.Thread(target=send, daemon=True).start()
with connection.makefile(encoding="utf-8") as lines:
    for line in lines:
        line = line.rstrip("\n")
        if line.startswith("*"):
            say(command=line)
        else:
            take(line, items)
say(closed=True)
