"""A grinder of docs/modbus.md on pymodbus: it travels its path and says what it was told; with a part it grinds that by its map."""

import struct

import part
from machine import PAYLOAD, Machine, serve


class Grinder(Machine):
    kind = 2
    name = "pymodbus grinder 1"
    payloads = (2, 3)

    def refuse(self, kind, data):
        if kind == 3:
            return 0 if data[:2] == b"\0\1" and len(data) == 128 else PAYLOAD
        form, sign, columns, rows = struct.unpack(">HHII", data[:12])
        return 0 if (form, sign) == (1, 1) and len(data) == 96 + 8 * columns * rows else PAYLOAD

    def work(self):
        wheel_radius_mm, feed_mm_min = struct.unpack(">dd", self.slots[3][0][8:24])
        path_mm = feed_mm_min / 60.0 * self.moved
        if self.part is not None:
            part.grind(self.part, self.slots[2][0])
        job, cycle, _ = self.job
        record = struct.pack(">IHHddddddd", job, cycle, self.result, path_mm, 0.0, 0.0, 1.0, 0.1, wheel_radius_mm, 0.0)
        return 5, 1, record, 1, 0, 0.0, self.slots[2][1]


if __name__ == "__main__":
    serve(Grinder())
