#!/usr/bin/env python3
"""Reads a file in the Q-DAS ASCII transfer format by the package aqdefreader and tells what that found, as JSON.

    read_aqdef.py FILE

The package reads a number with a decimal point as text, and it reads neither the serial number nor the text of a value. It
prints remarks, which go to the standard error.
"""
import contextlib
import json
import sys

import aqdefreader

HEAD = {"part_number": "K1001", "part_name": "K1002", "order": "K1053", "inspector": "K1222"}
CHARACTERISTIC = {"number": "K2001", "name": "K2002", "decimals": "K2022", "unit": "K2142"}
LIMITS = {"lower": "K2110", "upper": "K2111"}


def characteristic(read) -> dict:
    told = {name: read.get_data(key) for name, key in CHARACTERISTIC.items()}
    limits = {name: read.get_data(key) for name, key in LIMITS.items()}
    told |= {name: None if limit is None else float(limit) for name, limit in limits.items()}
    values = read.get_measurements()
    return told | {"values": [float(one.value) for one in values], "attributes": [one.attribute for one in values]}


def main(file: str) -> None:
    with contextlib.redirect_stdout(sys.stderr):
        read = aqdefreader.read_dfq_file(file)
    parts = read.get_parts()
    if len(parts) != 1:
        sys.exit(f"{len(parts)} parts, not one")
    head = {name: parts[0].get_data(key) for name, key in HEAD.items()}
    print(json.dumps({"head": head, "characteristics": [characteristic(one) for one in parts[0].get_characteristics()]}))


if __name__ == "__main__":
    main(*sys.argv[1:])
