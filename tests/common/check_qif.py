#!/usr/bin/env python3
"""Holds a QIF document against the schema of QIF 3.0 and tells what it says, as JSON.

    check_qif.py SCHEMA-FOLDER FILE

Needs lxml. What does not follow the schema goes to the error stream, and the exit code is 1.
"""
import json
import sys
from pathlib import Path

from lxml import etree

Q = "{http://qifstandards.org/xsd/qif3}"


def main(schema: str, file: str) -> None:
    document = etree.parse(file)
    rules = etree.XMLSchema(etree.parse(str(Path(schema) / "QIFDocument.xsd")))
    if not rules.validate(document):
        sys.exit("\n".join(f"line {error.line}: {error.message}" for error in rules.error_log))
    by_id = {element.get("id"): element for element in document.iter() if element.get("id")}
    if int(document.getroot().get("idMax")) != max(int(number) for number in by_id):
        sys.exit("idMax is not the largest identifier")

    def follow(element, name):
        return by_id[element.findtext(Q + name)]

    def told(value):
        item = follow(value, "CharacteristicItemId")
        definition = follow(follow(item, "CharacteristicNominalId"), "CharacteristicDefinitionId")
        limit = definition.findtext(f"{Q}Tolerance/{Q}MaxValue")
        found = value.find(Q + "Value")
        return {
            "name": definition.findtext(Q + "Name"),
            "found_mm": float(found.text),
            "standard_mm": float(found.get("combinedUncertainty")),
            "limit_mm": limit and float(limit),
            "status": value.findtext(f"{Q}Status/{Q}CharacteristicStatusEnum"),
        }

    def measured(results):
        attributes = {one.get("name"): one.get("value") for one in results.find(Q + "Attributes")}
        return {
            "cycle": int(attributes["cycle"]),
            "status": results.findtext(f"{Q}InspectionStatus/{Q}InspectionStatusEnum"),
            "reason": attributes["reason"],
            "operator": results.findtext(f".//{Q}InspectionOperator/{Q}Name"),
            "figures": [told(value) for value in results.iter(Q + "UserDefinedLinearCharacteristicMeasurement")],
        }

    component = document.find(f".//{Q}ActualComponent")
    print(json.dumps({
        "part": component.findtext(Q + "SerialNumber"),
        "status": component.findtext(f"{Q}Status/{Q}InspectionStatusEnum"),
        "measured": [measured(results) for results in document.iter(Q + "MeasurementResults")],
    }))


if __name__ == "__main__":
    main(*sys.argv[1:])
