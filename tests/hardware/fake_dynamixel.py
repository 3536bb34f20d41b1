"""Dynamixel motors with registers behind a pseudo-terminal: protocol 2.0, with checksums."""

import contextlib
import os
import time

from tests.hardware.fake_board import FakeLine

HEADER = b"\xff\xff\xfd\x00"
READ, WRITE, REBOOT, STATUS, SYNC_READ, SYNC_WRITE = 0x02, 0x03, 0x08, 0x55, 0x82, 0x83


def crc(data):
    """CRC-16, polynomial 0x8005, start 0, not reflected."""
    value = 0
    for byte in data:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1 ^ 0x8005 if value & 0x8000 else value << 1) & 0xFFFF
    return value


def packet(motor, instruction, body):
    stuffed = body.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
    head = HEADER + bytes([motor]) + (len(stuffed) + 3).to_bytes(2, "little") + bytes([instruction]) + stuffed
    return head + crc(head).to_bytes(2, "little")


class Motor:
    """Registers of one motor, and a tendon that is tight from an angle on."""

    def __init__(self):
        self.memory = bytearray(256)
        self.set(9, 1, 250)
        self.set(11, 1, 3)
        self.set(38, 2, 1193)
        self.set(68, 1, 2)
        self.tight, self.sign, self.torn, self.worn = 200, 1, False, 0
        self.heard = time.monotonic()

    def get(self, address, size, signed=False):
        return int.from_bytes(self.memory[address : address + size], "little", signed=signed)

    def set(self, address, size, value):
        self.memory[address : address + size] = (value % (1 << 8 * size)).to_bytes(size, "little")

    def move(self):
        goal, current = self.get(116, 4, True), self.get(102, 2, True)
        watchdog = self.get(98, 1)
        if self.get(64, 1) and 0 < watchdog < 128 and time.monotonic() - self.heard > 0.02 * watchdog:
            self.set(98, 1, 255)
        position, pull = self.get(132, 4, True), 0
        if self.get(64, 1) and self.get(98, 1) != 255 and current > 0:
            end = goal if self.torn else min(self.sign * goal, self.tight + current // 10) * self.sign
            pull = 0 if self.torn or end == goal else current * self.sign
            position = end
        self.set(132, 4, position)
        self.set(126, 2, pull)

    def write(self, address, data):
        """Write registers, and return the error of the status packet."""
        if address < 64:
            self.worn += 1
            if self.get(64, 1):
                return 7
        if 100 <= address < 120 and self.get(98, 1) == 255:
            return 7
        if address == 64 and data[0]:
            self.memory[116:120] = self.memory[132:136]
        self.memory[address : address + len(data)] = data
        self.move()
        return 0

    def read(self, address, size):
        self.move()
        place = [
            self.get(168 + 2 * (k - 224), 2) if 224 <= k < 252 else k for k in range(address, address + size)
        ]
        return bytes(self.memory[k] for k in place)


class FakeDynamixel(FakeLine):
    """A bus of motors in a thread."""

    def __init__(self, ids):
        self.motors = {motor: Motor() for motor in ids}
        self.silent, self.damage, self.count = set(), 0, 0
        self.bad, self.instructions = 0, []
        super().__init__()

    def _run(self):
        data = b""
        while not self._end.is_set():
            try:
                data += os.read(self._master, 1000)
            except OSError:
                self._end.wait(0.001)
            while (start := data.find(HEADER)) >= 0 and len(data) >= start + 7:
                size = int.from_bytes(data[start + 5 : start + 7], "little") + 7
                if len(data) < start + size:
                    break
                whole, data = data[start : start + size], data[start + size :]
                if crc(whole[:-2]) != int.from_bytes(whole[-2:], "little"):
                    self.bad += 1
                    continue
                self._obey(whole[4], whole[7], whole[8:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"))

    def _answer(self, motor, error, body=b""):
        if motor in self.silent:
            return
        alert = 0x80 if self.motors[motor].get(70, 1) else 0
        made = bytearray(packet(motor, STATUS, bytes([error | alert]) + body))
        self.count += 1
        if self.damage and self.count % self.damage == 0:
            made[-3] ^= 1
        with contextlib.suppress(OSError):
            os.write(self._master, bytes(made))

    def _obey(self, motor, instruction, body):
        self.instructions.append(instruction)
        for each in self.motors.values():
            each.move()
            each.heard = time.monotonic()
        first, second = int.from_bytes(body[:2], "little"), int.from_bytes(body[2:4], "little")
        if instruction == SYNC_WRITE:
            for k in range(4, len(body), second + 1):
                if body[k] in self.motors and body[k] not in self.silent:
                    self.motors[body[k]].write(first, body[k + 1 : k + 1 + second])
        elif instruction == SYNC_READ:
            for each in body[4:]:
                if each in self.motors:
                    self._answer(each, 0, self.motors[each].read(first, second))
        elif motor in self.motors and instruction == READ:
            self._answer(motor, 0, self.motors[motor].read(first, second))
        elif motor in self.motors and instruction == WRITE:
            self._answer(motor, self.motors[motor].write(first, body[2:]))
        elif motor in self.motors and instruction == REBOOT:
            for address, size in ((64, 1), (70, 1), (98, 1), (102, 2)):
                self.motors[motor].set(address, size, 0)
            self._answer(motor, 0)
