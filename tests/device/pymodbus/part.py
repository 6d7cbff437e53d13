"""The part between a grinder and a measuring machine that are two processes: a file with the map that it was ground by last.

The grinder leaves what it was commanded and a wave of its own, the same in every pass; of the wave nothing is known to a client.
"""

import math
import struct


def grind(path, map_payload):
    path.write_bytes(map_payload)


def error_mm(path, x, y):
    """How far the surface stands proud of the one commanded, over x, y of the model frame."""
    return 0.008 * math.sin(x / 9.0) * math.cos(y / 7.0) + 0.004 * math.cos(x / 15.0 + y / 11.0) + asked_mm(path.read_bytes(), x, y)


def asked_mm(payload, x, y):
    """The displacement that a map asks for, bilinear between its nodes and level beyond them."""
    columns, rows = struct.unpack(">II", payload[4:12])
    first_x, first_y, step_x, step_y = struct.unpack(">4d", payload[16:48])

    def between(at, first, step, nodes):
        u = min(max((at - first) / step, 0.0), nodes - 1)
        cell = min(int(u), nodes - 2)
        return cell, u - cell

    def node(i, j):
        return struct.unpack_from(">d", payload, 96 + 8 * (j * columns + i))[0]

    (i, u), (j, v) = between(x, first_x, step_x, columns), between(y, first_y, step_y, rows)
    low = (1 - u) * node(i, j) + u * node(i + 1, j)
    high = (1 - u) * node(i, j + 1) + u * node(i + 1, j + 1)
    return (1 - v) * low + v * high
