#!/usr/bin/env python3
"""Reads a file in the Q-DAS ASCII transfer format by the published list of K-fields and tells what it says, as JSON.

    read_dfq.py FILE

A field is `Knnnn value` or `Knnnn/k value`, k the number of the characteristic; K0001 begins a value, and the fields K0002 to
K0099 that follow belong to it. Any field that is not on the list ends the reading.
"""
import json
import re
import sys
from datetime import datetime

LIST = {
    "K0001": "value", "K0002": "attribute", "K0004": "time", "K0009": "text", "K0014": "part",
    "K0100": "characteristics", "K1001": "part_number", "K1002": "part_name", "K1053": "order", "K1082": "machine",
    "K1203": "reason", "K1222": "inspector", "K1900": "remark",
    "K2001": "number", "K2002": "name", "K2004": "kind", "K2022": "decimals", "K2101": "nominal", "K2110": "lower",
    "K2111": "upper", "K2120": "lower_kind", "K2121": "upper_kind", "K2142": "unit", "K2401": "gauge", "K2402": "gauge_name",
    "K2900": "remark",
}
NUMBERS = {"value", "nominal", "lower", "upper"}
COUNTS = {"attribute", "characteristics", "number", "kind", "decimals", "lower_kind", "upper_kind"}


def field(line: str, number: int):
    match = re.fullmatch(r"(K\d{4})(?:/(\d+))? (\S.*)", line)
    if not match:
        sys.exit(f"line {number}: no field: {line!r}")
    key, index, text = match.groups()
    name = LIST.get(key) or sys.exit(f"line {number}: {key} is not on the list")
    if name in NUMBERS:
        text = float(text)
    elif name in COUNTS:
        text = int(text)
    elif name == "time":
        text = datetime.strptime(text, "%d.%m.%Y/%H:%M:%S").isoformat()
    return key, int(index or 0), name, text


def main(file: str) -> None:
    data = open(file, "rb").read()
    text = data.decode("utf-8-sig" if data.startswith(b"\xef\xbb\xbf") else "ascii")
    if not text.endswith("\r\n") or text.count("\n") != text.count("\r\n"):
        sys.exit("a line does not end as it should")
    head, characteristics, values = {}, {}, {}
    for number, line in enumerate(text.split("\r\n")[:-1], 1):
        key, index, name, told = field(line, number)
        if number == 1 and key != "K0100":
            sys.exit("the first field must be K0100")
        if key < "K0100":
            rows = values.setdefault(index, [])
            if name == "value":
                rows.append({})
            rows[-1][name] = told
        else:
            place = characteristics.setdefault(index, {}) if key >= "K2000" else head
            if name in place:
                sys.exit(f"line {number}: {key} a second time")
            place[name] = told
    if sorted(characteristics) != list(range(1, head["characteristics"] + 1)):
        sys.exit(f"{head['characteristics']} characteristics were to come, {sorted(characteristics)} are told of")
    if set(values) - set(characteristics):
        sys.exit("a value belongs to no characteristic")
    print(json.dumps({"head": head, "characteristics": [characteristics[k] | {"values": values.get(k, [])} for k in sorted(characteristics)]}))


if __name__ == "__main__":
    main(*sys.argv[1:])
