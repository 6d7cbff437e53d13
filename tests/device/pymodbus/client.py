"""A client of docs/modbus.md on pymodbus: has a measuring machine measure ten points and prints them. `client.py HOST PORT [UNIT]`."""

import binascii
import hashlib
import random
import struct
import sys
import time

from machine import ABORT, ACKNOWLEDGE, CLAIM, COMPLETE, EXECUTE, IDLE, PREPARE, PREPARED, START, bytes_of, crc16, registers_of
from pymodbus.client import ModbusTcpClient

RADIUS_MM = 1.5
POINTS = 10
OWNER = 0xC0FFEE


class Client:
    def __init__(self, host, port, unit):
        self.wire, self.unit = ModbusTcpClient(host, port=port), unit
        assert self.wire.connect(), "not connected"
        self.sequence = 0
        self.beats = 0

    def read(self, address, count):
        answer = self.wire.read_holding_registers(address, count=count, device_id=self.unit)
        assert not answer.isError(), answer
        assert len(answer.registers) == count
        return bytes_of(answer.registers)

    def write(self, address, data):
        answer = self.wire.write_registers(address, registers_of(data), device_id=self.unit)
        assert not answer.isError(), (address, answer)

    def meet(self):
        identity = self.read(0, 32)
        magic, version, kind, whole, real = struct.unpack(">IHHId", identity[:20])
        assert (magic, version, kind, whole, real) == (0x52474431, 2, 1, 0x12345678, -2.5e-7), identity.hex()
        nonce = random.randbytes(4)
        self.write(32, nonce)
        assert self.read(32, 4) == nonce + bytes(byte ^ 0xFF for byte in nonce)
        self.sequence = self.status()["acknowledged"]

    def status(self):
        self.beats = (self.beats + 1) & 0xFFFF
        self.write(36, struct.pack(">HI", self.beats, OWNER))
        while True:
            words = self.read(64, 48)
            if words[:2] == words[94:]:
                break
        at = lambda form, register: struct.unpack_from(">" + form, words, 2 * register)[0]
        return {
            "state": at("H", 1), "acknowledged": at("I", 4), "answer": at("H", 6), "job": at("I", 8), "cycle": at("H", 10),
            "digest": at("I", 12), "token": at("I", 14), "done": at("I", 16), "result": at("H", 18), "begun_by": at("I", 36),
        }

    def command(self, number, job=(0, 0, 0), token=0, argument=0):
        self.sequence += 1
        (job, cycle, digest) = job
        frame = struct.pack(">IHHIIIIII", self.sequence, number, cycle, OWNER, 1, job, digest, token, argument)
        frame += struct.pack(">HHI", crc16(frame), 0, self.sequence)
        self.write(40, frame)
        self.write(40, frame)  # the same once more changes nothing
        status = self.until(lambda status: status["acknowledged"] == self.sequence)
        assert status["answer"] == 1, (number, status)
        return status

    def until(self, holds):
        for _ in range(3000):
            status = self.status()
            if holds(status):
                return status
            time.sleep(0.01)
        raise AssertionError(status)

    def load(self, data, identity):
        crc = binascii.crc32(data)
        self.write(200, struct.pack(">HHIIHH", 1, 0, len(data), crc, 0, 0) + identity)
        for page in range(-(-len(data) // 224)):
            part = data[224 * page : 224 * (page + 1)]
            self.write(224, struct.pack(">IH10x", page, len(part) // 2) + part)
        kind, state, _, size, computed = struct.unpack(">HHIII", self.read(350, 12)[:16])
        assert (kind, state, size, computed) == (1, 2, len(data), crc), (kind, state, size, computed)
        kind, state, size, computed = struct.unpack(">HHII", self.read(120, 24)[:12])
        assert (kind, state, size, computed) == (1, 1, len(data), crc)
        assert self.read(128, 16) == identity

    def collect(self, job, identity, done):
        header = self.read(400, 56)
        kind, form, size, crc, number, cycle, coordinates, records = struct.unpack(">HHIIIHHI", header[:24])
        assert (kind, form, size, (number, cycle), coordinates) == (4, 1, 32 * records, job[:2], 1), header.hex()
        assert header[60:92] == identity and struct.unpack(">I", header[92:96])[0] == done
        data = b""
        for page in range(-(-size // 224)):
            self.write(460, struct.pack(">I", page))
            due = min(112, (size - len(data)) // 2)
            words = self.read(462, 4 + due)
            assert struct.unpack(">IH", words[:6]) == (page, due)
            data += words[8:]
        assert self.read(400, 56) == header and binascii.crc32(data) == crc
        return [struct.unpack(">IHHddd", data[at : at + 32]) for at in range(0, size, 32)]


def plan(targets):
    data = struct.pack(">HHIddddd16x", 1, 0, len(targets), RADIUS_MM, 1.0, 1.0, 2.0, 10.0)
    return data + b"".join(struct.pack(">IHHdddddd", index, 1, 0, *point, *normal) for index, (point, normal) in enumerate(targets))


def main():
    host, port = sys.argv[1], int(sys.argv[2])
    client = Client(host, port, int(sys.argv[3]) if len(sys.argv) > 3 else 1)
    client.meet()
    client.command(CLAIM)
    targets = [((float(k), 0.5 * k, 0.0), (0.0, 0.0, 1.0)) for k in range(POINTS)]
    data = plan(targets)
    identity = hashlib.sha256(data).digest()
    client.load(data, identity)
    job = (77, 1, binascii.crc32(identity))
    client.command(PREPARE, job)
    status = client.until(lambda status: status["state"] == PREPARED)
    assert (status["job"], status["cycle"], status["digest"]) == job and status["token"], status
    start = client.command(START, job, token=status["token"])
    assert start["begun_by"] == client.sequence and start["state"] in (EXECUTE, COMPLETE), start
    end = client.until(lambda status: status["state"] == COMPLETE)
    assert (end["done"], end["result"]) == (start["begun_by"], 1), end
    points = client.collect(job, identity, end["done"])
    client.command(ACKNOWLEDGE, argument=end["done"])
    client.until(lambda status: status["state"] == IDLE)
    for index, status, quality, x, y, z in points:
        print(index, status, quality, repr(x), repr(y), repr(z))
    client.command(ABORT)
    client.wire.close()


if __name__ == "__main__":
    main()
