"""A measuring machine of docs/modbus.md on pymodbus: it touches every point where it should be, and a known bit beside it.

With a part it touches that where it stands, in the frame of the model.
"""

import struct

import part
from machine import PAYLOAD, Machine, serve

# How far beside the exact centre each point is given, in mm: 0.1 um along x for every odd index.
ERROR_MM = 1e-4


class Cmm(Machine):
    kind = 1
    name = "pymodbus CMM 1"
    payloads = (1,)

    def refuse(self, _kind, data):
        (form, _, targets) = struct.unpack(">HHI", data[:8])
        return 0 if form == 1 and len(data) == 64 + 56 * targets else PAYLOAD

    def total(self):
        return (len(self.slots[1][0]) - 64) // 56 if 1 in self.slots else 0

    def work(self):
        plan, identity = self.slots[1]
        (radius,) = struct.unpack(">d", plan[8:16])
        records = b""
        for at in range(64, len(plan), 56):
            index, what, _, x, y, z, nx, ny, nz = struct.unpack(">IHHdddddd", plan[at : at + 56])
            out = radius
            if self.part is None:
                x += ERROR_MM * (index % 2)
            elif what == 1:
                out += part.error_mm(self.part, x, y)
            records += struct.pack(">IHHddd", index, 1, 0, x + out * nx, y + out * ny, z + out * nz)
        return 4, 1, records, self.total(), 1, radius, identity


if __name__ == "__main__":
    serve(Cmm())
