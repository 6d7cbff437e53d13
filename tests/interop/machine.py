"""A machine of docs/modbus.md on pymodbus, written from that page alone: registers, handshake, payloads, results.

It is small and kind: it moves at once, never fails, and has no interlock that opens. What it does with a job is left to the two machines
that import it.
"""

import argparse
import asyncio
import binascii
import random
import struct
import time

from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

IDLE, PREPARED, EXECUTE, HELD, COMPLETE, ABORTED = 1, 2, 3, 5, 7, 9
CLAIM, PREPARE, START, HOLD, RESUME, STOP, ABORT, CLEAR, ACKNOWLEDGE, RELEASE = range(1, 11)
ACCEPTED, NOT_OWNER, WRONG_STATE, UNKNOWN, TOKEN, OTHER, BEGUN, PAYLOAD, _, _, ARGUMENT = range(1, 12)
READABLE = [(0, 32), (32, 4), (36, 1), (40, 20), (64, 48), (120, 72), (200, 24), (224, 120), (350, 12), (400, 56), (460, 2), (462, 116)]
WRITABLE = [(32, 2), (36, 1), (40, 20), (200, 24), (224, 120), (460, 2)]
PAGE_BYTES = 224


def registers_of(data):
    data = data + b"\0" * (len(data) % 2)
    return list(struct.unpack(f">{len(data) // 2}H", data))


def bytes_of(registers):
    return struct.pack(f">{len(registers)}H", *registers)


def crc16(data):
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return crc


class Machine:
    """Everything that both machines have in common. Words stand high first."""

    def __init__(self, kind, name, needs):
        self.kind, self.name, self.needs = kind, name, needs
        self.boot_id = random.randint(1, 0xFFFFFFFF)
        self.state, self.answer, self.acknowledged = IDLE, 0, 0
        self.job = self.cycle = self.digest = self.token = 0
        self.done = self.result = self.begun_by = 0
        self.owner = self.epoch = 0
        self.last_begun = (0, 0)
        self.snapshot, self.last_image = 0, None
        self.slots = {}
        self.header = None
        self.pages, self.received, self.inbox_state, self.reason = 0, b"", 0, 0
        self.outbox = None
        self.started_at = 0.0

    # What the two machines fill in.

    def refuse(self, kind, data):
        """The answer number of a payload that cannot be used, or 0."""
        return 0

    def total(self):
        return 1000

    def work(self):
        """The result of the job: kind, format, bytes, records, coordinates, probe radius, identity."""
        raise NotImplementedError

    # Registers.

    async def access(self, function, start, address, count, registers, values):
        """Called by pymodbus before each read and each write."""
        if function not in (3, 16):
            return ExcCodes.ILLEGAL_FUNCTION
        if values is None:
            if not all(any(a <= r < a + n for a, n in READABLE) for r in range(address, address + count)):
                return ExcCodes.ILLEGAL_ADDRESS
            self.advance()
            self.show(registers)
            return None
        if not any(a <= address and address + count <= a + n for a, n in WRITABLE):
            return ExcCodes.ILLEGAL_ADDRESS
        if address == 200:
            return None if self.announce(values) else ExcCodes.ILLEGAL_VALUE
        if address == 224:
            return None if self.page(values) else ExcCodes.ILLEGAL_VALUE
        if address <= 59 and address + count == 60:
            self.command((registers[40:address] + list(values))[:20])
        return None

    def show(self, registers):
        def put(at, data):
            words = registers_of(data)
            registers[at : at + len(words)] = words

        put(0, struct.pack(">HHHHIdIHHHH", 0x5247, 0x4431, 1, self.kind, 0x12345678, -2.5e-7, self.boot_id, 1, 1, 0, 0))
        put(32, self.name.encode("ascii")[:32].ljust(32, b"\0"))  # offset 16 registers is byte 32 of the block
        registers[16:32], registers[32:48] = registers[32:48], registers[16:32]
        registers[32:40] = self.kept(registers)
        put(64, self.status(registers[36]))
        put(120, b"".join(self.slot(kind) for kind in (1, 2, 3)))
        put(350, self.inbox())
        put(400, self.outbox_header())
        put(462, self.outbox_page(registers[460] << 16 | registers[461]))

    def kept(self, registers):
        raise NotImplementedError
