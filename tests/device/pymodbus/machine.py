"""A machine of docs/modbus.md on pymodbus, written from that page alone: registers, handshake, payloads, results.

It is small and kind: it never fails, has no interlock that opens, and comes to a halt at once. What it does with a job is left to the
two machines that import it. Words stand high first.
"""

import argparse
import asyncio
import binascii
import pathlib
import random
import struct
import time

from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

IDLE, PREPARED, EXECUTE, HELD, COMPLETE, ABORTED, FAULTED = 1, 2, 3, 5, 7, 9, 10
CLAIM, PREPARE, START, HOLD, RESUME, STOP, ABORT, CLEAR, ACKNOWLEDGE, RELEASE = range(1, 11)
ACCEPTED, NOT_OWNER, WRONG_STATE, UNKNOWN, TOKEN, OTHER, BEGUN, PAYLOAD = range(1, 9)
ARGUMENT = 11
BLOCKS = [
    (0, 32), (32, 4), (36, 3), (40, 20), (64, 48), (120, 72), (200, 24), (224, 120), (350, 12), (400, 56), (460, 2), (462, 116),
]
WRITABLE = [(32, 2), (36, 3), (40, 20), (200, 24), (224, 120), (460, 2)]
ALLOWED = {
    PREPARE: [IDLE],
    START: [PREPARED],
    HOLD: [EXECUTE],
    RESUME: [HELD],
    STOP: [PREPARED, EXECUTE, HELD],
    CLEAR: [ABORTED, FAULTED],
    ACKNOWLEDGE: [COMPLETE],
    RELEASE: [IDLE, PREPARED, HELD, COMPLETE, ABORTED, FAULTED],
}
PAGE_BYTES = 224


def registers_of(data):
    data += b"\0" * (len(data) % 2)
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
    """Everything that both machines have in common."""

    kind = 0
    name = ""
    payloads = ()
    seconds = 0.2
    # The file that stands for the part, where the machines work on one.
    part = None
    # Whether full pages of the result can be read while the job runs, and how long a record is.
    ahead, record_bytes = False, 32

    def __init__(self):
        self.boot_id = random.randint(1, 0xFFFFFFFF)
        self.state, self.answer, self.acknowledged = IDLE, 0, 0
        self.job = (0, 0, 0)
        self.token = self.done = self.result = self.begun_by = 0
        self.owner = self.epoch = self.heard = self.beaten = 0
        self.begun = []
        self.snapshot, self.shown = 0, b""
        self.slots = {}
        self.inbox = (0, 0, 0, bytes(32))
        self.received, self.inbox_state, self.reason = b"", 0, 0
        self.outbox = None
        self.moved = 0.0
        self.since = time.monotonic()

    # What the two machines fill in.

    def refuse(self, kind, data):
        """The answer number of a payload that cannot be used, or 0."""
        return 0

    def total(self):
        return 1000

    def duration_s(self):
        return self.moved

    def work(self):
        """The result: kind, format, bytes, records, what the coordinates are, probe radius, identity of what was used."""
        raise NotImplementedError

    # Registers.

    async def access(self, function, _start, address, count, registers, values):
        """Called by pymodbus before each read and each write."""
        if function not in (3, 16):
            return ExcCodes.ILLEGAL_FUNCTION
        blocks = BLOCKS if values is None else WRITABLE
        if values is None:
            inside = all(any(a <= r < a + n for a, n in blocks) for r in range(address, address + count))
        else:
            inside = any(a <= address and address + count <= a + n for a, n in blocks)
        if not inside:
            return ExcCodes.ILLEGAL_ADDRESS
        self.advance()
        if values is None:
            self.show(registers)
        elif address == 200:
            return None if count == 24 and self.header(bytes_of(values)) else ExcCodes.ILLEGAL_VALUE
        elif 224 <= address < 344:
            return None if address == 224 and count > 8 and self.page(bytes_of(values)) else ExcCodes.ILLEGAL_VALUE
        elif 36 <= address < 39:
            return None if count == 3 and self.beat(bytes_of(values)) else ExcCodes.ILLEGAL_VALUE
        elif address >= 40 and address + count == 60:
            self.command(bytes_of(registers[40:address] + list(values)))
        return None

    def show(self, registers):
        def put(at, data):
            words = registers_of(data)
            registers[at : at + len(words)] = words

        identity = struct.pack(">4HId", 0x5247, 0x4431, 2, self.kind, 0x12345678, -2.5e-7)
        put(0, identity + struct.pack(">I4H", self.boot_id, 1 | self.ahead << 1, 1, 0, 0) + self.name.encode("ascii").ljust(32, b"\0"))
        registers[34], registers[35] = registers[32] ^ 0xFFFF, registers[33] ^ 0xFFFF
        put(64, self.status(self.beaten))
        put(120, b"".join(self.slot(kind) for kind in (1, 2, 3)))
        kind, _, _, _ = self.inbox
        pages = -(-len(self.received) // PAGE_BYTES)
        crc = binascii.crc32(self.received)
        put(350, struct.pack(">HHIIIHHHH", kind, self.inbox_state, pages, len(self.received), crc, self.reason, 0, 0, 0))
        put(400, self.outbox_header())
        put(462, self.outbox_page(registers[460] << 16 | registers[461]))

    def status(self, echo):
        progress = self.progress() if self.job[0] else 0
        beat = int(time.monotonic() * 10) & 0xFFFF
        last_job, last_cycle = self.begun[-1] if self.begun else (0, 0)
        job, cycle, digest = self.job
        body = struct.pack(">HHHIHH", self.state, 1, 15, self.acknowledged, self.answer, 0)
        body += struct.pack(">IHHIIIHH", job, cycle, 0, digest, self.token, self.done, self.result, 0)
        body += struct.pack(">IIIIHH", progress, self.total(), self.owner, self.epoch, beat, echo)
        body += struct.pack(">IHhII", last_job, last_cycle, 2000, self.boot_id, self.begun_by) + bytes(18)
        if body != self.shown:
            self.snapshot, self.shown = (self.snapshot + 1) & 0xFFFF, body
        number = struct.pack(">H", self.snapshot)
        return number + body + number

    def slot(self, kind):
        if kind not in self.slots:
            return struct.pack(">H46x", kind)
        data, identity = self.slots[kind]
        return struct.pack(">HHIIHH", kind, 1, len(data), binascii.crc32(data), 0, 0) + identity

    # Payloads in, results out.

    def header(self, data):
        kind, _, size, crc = struct.unpack(">HHII", data[:12])
        if kind not in self.payloads or self.state in (EXECUTE, HELD) or not 0 < size <= 1 << 26:
            return False
        self.inbox = (kind, size, crc, data[16:48])
        self.received, self.inbox_state, self.reason = b"", 1, 0
        return True

    def page(self, data):
        number, count = struct.unpack(">IH", data[:6])
        kind, size, crc, identity = self.inbox
        pages = -(-len(self.received) // PAGE_BYTES)
        if self.inbox_state and number < pages:
            return True
        due = min(PAGE_BYTES, size - len(self.received))
        if self.inbox_state != 1 or number != pages or count != -(-due // 2) or len(data) != 16 + 2 * count:
            return False
        self.received += data[16 : 16 + due]
        if len(self.received) == size:
            self.reason = self.refuse(kind, self.received)
            self.inbox_state = 3 if binascii.crc32(self.received) != crc else 4 if self.reason else 2
            if self.inbox_state == 2:
                self.slots[kind] = (self.received, identity)
        return True

    def progress(self):
        return int(self.total() * min(1.0, self.moved / self.seconds))

    def so_far(self):
        """Of a job that runs the records that there are, which will not change; none for a machine that gives all at the end."""
        if not self.ahead or self.state not in (EXECUTE, HELD):
            return None
        kind, form, data, *rest = self.work()
        return kind, form, data[: self.progress() * self.record_bytes], *rest

    def outbox_header(self):
        ended = self.state == COMPLETE
        outbox = self.outbox if ended else self.so_far()
        if outbox is None:
            return bytes(112)
        kind, form, data, records, coordinates, radius, identity = outbox
        job, cycle, _ = self.job
        crc = binascii.crc32(data) if ended else 0
        records = records if ended else self.progress()
        head = struct.pack(">HHIIIHHI", kind, form, len(data), crc, job, cycle, coordinates, records)
        head += struct.pack(">ddddHH", radius, 1.0, 20.0, self.duration_s(), 1, 0) + identity
        return head + struct.pack(">I16x", self.done if ended else 0)

    def outbox_page(self, number):
        outbox = self.outbox if self.state == COMPLETE else self.so_far()
        data = outbox[2][number * PAGE_BYTES : (number + 1) * PAGE_BYTES] if outbox else b""
        if self.state != COMPLETE and len(data) < PAGE_BYTES:
            data = b""
        return (struct.pack(">IHH", number, len(data) // 2, 0) + data).ljust(232, b"\0")

    # Beats: only those of the owner count.

    def beat(self, data):
        counter, owner = struct.unpack(">HI", data)
        if owner == self.owner and owner and counter != self.beaten:
            self.beaten, self.heard = counter, time.monotonic()
        return True

    # Commands.

    def command(self, frame):
        sequence, command, cycle, owner, epoch, job, digest, token, argument = struct.unpack(">IHHIIIIII", frame[:32])
        crc, _, again = struct.unpack(">HHI", frame[32:40])
        if crc != crc16(frame[:32]) or again != sequence or sequence in (0, self.acknowledged):
            return
        if sequence < self.acknowledged and command not in (CLAIM, ABORT):
            return
        self.acknowledged = sequence
        self.answer = self.judge(command, (job, cycle, digest), owner, epoch, token, argument)
        if self.answer == ACCEPTED:
            self.act(command, sequence, (job, cycle, digest), owner, epoch)

    def judge(self, command, job, owner, epoch, token, argument):
        if command == CLAIM:
            silent = time.monotonic() - self.heard > 3.0
            return ACCEPTED if self.owner == 0 or silent or (owner == self.owner and epoch >= self.epoch) else NOT_OWNER
        if command == ABORT:
            return ACCEPTED
        if (owner, epoch) != (self.owner, self.epoch):
            return NOT_OWNER
        if command not in ALLOWED:
            return UNKNOWN
        if self.state not in ALLOWED[command]:
            return WRONG_STATE
        if command == PREPARE:
            if any(kind not in self.slots for kind in self.payloads):
                return PAYLOAD
            identities = b"".join(self.slots[kind][1] for kind in self.payloads)
            return ACCEPTED if job[0] and job[2] == binascii.crc32(identities) else OTHER
        if command == START:
            if token != self.token or not token:
                return TOKEN
            if job != self.job:
                return OTHER
            return BEGUN if job[:2] in self.begun else ACCEPTED
        if command == ACKNOWLEDGE and argument != self.done:
            return ARGUMENT
        return ACCEPTED

    def act(self, command, sequence, job, owner, epoch):
        self.token = 0
        if command == CLAIM:
            self.owner, self.epoch, self.heard = owner, epoch, time.monotonic()
        elif command == PREPARE:
            self.state, self.job, self.token = PREPARED, job, random.randint(1, 0xFFFFFFFF)
            self.begun_by, self.moved = 0, 0.0
        elif command == START:
            self.begun.append(job[:2])
            self.state, self.begun_by, self.since = EXECUTE, sequence, time.monotonic()
        elif command == HOLD:
            self.state = HELD
        elif command == RESUME:
            self.state, self.since = EXECUTE, time.monotonic()
        elif command == STOP:
            if self.state == PREPARED:
                self.state = IDLE
            else:
                self.end(COMPLETE, 2)
        elif command == ABORT:
            if self.state in (EXECUTE, HELD):
                self.end(ABORTED, 3)
            self.state = ABORTED
        elif command == CLEAR:
            self.state = IDLE
        elif command == ACKNOWLEDGE:
            self.state, self.done, self.result, self.outbox = IDLE, 0, 0, None
        elif command == RELEASE:
            self.owner = self.epoch = 0

    def end(self, state, result):
        self.state, self.done, self.result = state, self.begun_by, result
        self.outbox = self.work()

    def advance(self):
        now = time.monotonic()
        if self.state == EXECUTE:
            self.moved += now - self.since
            if self.moved >= self.seconds:
                self.end(COMPLETE, 1)
        self.since = now


def serve(machine):
    """Serves a machine until the process is ended; prints the port, which may have been chosen freely (port 0)."""
    arguments = argparse.ArgumentParser()
    arguments.add_argument("--host", default="127.0.0.1")
    arguments.add_argument("--port", type=int, default=0)
    arguments.add_argument("--unit", type=int, default=1)
    arguments.add_argument("--part", type=pathlib.Path, help="file that stands for the part (part.py)")
    arguments.add_argument("--seconds", type=float, default=machine.seconds, help="how long a job takes")
    arguments.add_argument("--ahead", action="store_true", help="gives full pages of the result while the job runs (a CMM)")
    given = arguments.parse_args()
    machine.part, machine.seconds, machine.ahead = given.part, given.seconds, given.ahead

    async def main():
        registers = SimData(0, values=[0] * 578, datatype=DataType.REGISTERS)
        device = SimDevice(given.unit, simdata=[registers], action=machine.access)
        server = ModbusTcpServer(device, address=(given.host, given.port))
        await server.listen()
        print("port", server.transport.sockets[0].getsockname()[1], flush=True)
        await asyncio.Event().wait()

    asyncio.run(main())
