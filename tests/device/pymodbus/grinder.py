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

    def path_mm(self):
        spacing, _, _, x0, x1, y0, y1 = struct.unpack(">ddddddd", self.slots[3][0][24:80])
        return (x1 - x0) * (y1 - y0) / spacing * min(1.0, self.moved / self.seconds)

    def duration_s(self):
        # Its clock runs faster than the shop's, so that nobody waits for a test.
        return self.path_mm() / struct.unpack(">d", self.slots[3][0][16:24])[0] * 60.0

    def work(self):
        (wheel_radius_mm,) = struct.unpack(">d", self.slots[3][0][8:16])
        path_mm = self.path_mm()
        if self.part is not None:
            part.grind(self.part, self.slots[2][0])
        job, cycle, _ = self.job
        record = struct.pack(">IHHddddddd", job, cycle, self.result, path_mm, 0.0, 0.0, 1.0, 0.1, wheel_radius_mm, 0.0)
        return 5, 1, record, 1, 0, 0.0, self.slots[2][1]


if __name__ == "__main__":
    serve(Grinder())
