"""A server of I++ DME, written from the facts of the standard alone: a probe over a cap of a sphere.

It acknowledges each command as it comes, carries one out after another, and prints the port that it got.
"""

import math
import re
import socket

CENTRE, RADIUS = (0.0, 0.0, -50.0), 60.0
TIP = 1.5
LINE = re.compile(r"^(\d{5}|E\d{4}) (\w+)\((.*)\)$")
PROPERTY = re.compile(r"([A-Za-z.]+)\(([^()]*)\)")


class Machine:
    def __init__(self):
        self.homed = False
        self.session = False
        self.latched = False
        self.tool = "NoTool"
        self.frame = "MachineCsy"
        self.at = {"X": 0.0, "Y": 0.0, "Z": 300.0}
        self.kept = {}
        self.report = ["X", "Y", "Z"]

    def answer(self, name, inside):
        """Returns lines of data, or raises an error of the standard."""
        if self.latched and name not in ("ClearAllErrors", "GetXtdErrStatus", "GetErrStatusE", "AbortE"):
            raise Refused(2, 514, "Use ClearAllErrors to continue")
        told = getattr(self, "on_" + name, None)
        if told is None:
            raise Refused(3, 501, "Unsupported command")
        return told(inside) or []

    def on_StartSession(self, _):
        if self.session:
            raise Refused(3, 8, "Protocol error")
        self.session = True

    def on_EndSession(self, _):
        self.session = False

    def on_ClearAllErrors(self, _):
        self.latched = False

    def on_GetErrStatusE(self, _):
        return [f"ErrStatus({int(self.latched)})"]

    def on_AbortE(self, _):
        self.latched = True

    def on_GetMachineClass(self, _):
        return ["GetMachineClass(CartCMM_Simulated)"]

    def on_EnumTools(self, _):
        return ['"NoTool"', '"Probe1"']

    def on_IsHomed(self, _):
        return [f"IsHomed({int(self.homed)})"]

    def on_Home(self, _):
        self.homed = True

    def on_ChangeTool(self, inside):
        self.moves()
        self.tool = inside.strip('"')

    def on_SetCoordSystem(self, inside):
        self.frame = inside

    def on_GetCoordSystem(self, _):
        return [f"CoordSystem({self.frame})"]

    def on_SetProp(self, inside):
        self.kept.update((name, float(value)) for name, value in PROPERTY.findall(inside))

    def on_GetProp(self, inside):
        names = [name for name, _ in PROPERTY.findall(inside)]
        told = {**self.kept, "Tool.AvrRadius": TIP if self.tool == "Probe1" else 0.0}
        if any(name not in told for name in names):
            raise Refused(3, 510, "Bad property")
        return [", ".join(f"{name}({told[name]:.5f})" for name in names)]

    def on_OnPtMeasReport(self, inside):
        names = [name for name, _ in PROPERTY.findall(inside)]
        # As in version 1.4: touches have no quality.
        if "Q" in names:
            raise Refused(3, 502, "Incorrect arguments")
        self.report = names

    def on_Get(self, inside):
        return [", ".join(f"{axis}({self.at[axis]:.5f})" for axis, _ in PROPERTY.findall(inside))]

    def on_GoTo(self, inside):
        self.moves()
        self.at.update((axis, float(value)) for axis, value in PROPERTY.findall(inside))

    def on_PtMeas(self, inside):
        self.moves()
        given = {name: [float(value) for value in values.split(",")] for name, values in PROPERTY.findall(inside)}
        point, normal = [given[axis][0] for axis in "XYZ"], given["IJK"]
        norm = math.sqrt(sum(n * n for n in normal))
        normal = [n / norm for n in normal]
        # The tip comes down the normal and stops where its centre is as far from the sphere's as both radii.
        away = [p - c for p, c in zip(point, CENTRE)]
        along = sum(a * n for a, n in zip(away, normal))
        inside_root = along**2 - sum(a * a for a in away) + (RADIUS + TIP) ** 2
        if inside_root < 0:
            raise Refused(2, 1006, "Surface not found")
        way = -along + math.sqrt(inside_root)
        centre = [p + way * n for p, n in zip(point, normal)]
        self.at = dict(zip("XYZ", (c + self.kept["Tool.PtMeasPar.Retract"] * n for c, n in zip(centre, normal))))
        told = {axis: f"{value:.7f}" for axis, value in zip("XYZ", centre)}
        told |= {"ER": str(TIP), "IJK": ", ".join(f"{n:.6f}" for n in normal)}
        # In an order of its own.
        return [", ".join(f"{name}({told[name]})" for name in sorted(self.report))]

    def moves(self):
        if not self.homed:
            raise Refused(3, 508, "Bad context")


class Refused(Exception):
    pass


def answered(machine, line):
    """Yields the lines that answer one."""
    tag, name, inside = LINE.match(line).groups()
    yield f"{tag} &"
    try:
        for data in machine.answer(name, inside):
            yield f"{tag} # {data}"
    except Refused as refused:
        severity, number, text = refused.args
        machine.latched |= severity >= 2
        cause = line.replace('"', "#")
        yield f'{tag} ! Error({severity}, {number:04}, "{cause}", "{text}")'
    yield f"{tag} %"


def main():
    listener = socket.create_server(("127.0.0.1", 0))
    print(listener.getsockname()[1], flush=True)
    machine = Machine()
    while True:
        client, _ = listener.accept()
        machine.session = False
        with client, client.makefile("rwb") as stream:
            try:
                for line in stream:
                    for answer in answered(machine, line.decode("ascii").rstrip("\r\n")):
                        stream.write(answer.encode("ascii") + b"\r\n")
                    stream.flush()
            except OSError:
                pass


main()
