"""The boot loader in an STM32F405's ROM, by AN3155, on a line with its own clock: for tests of flashing."""

from functools import reduce
from operator import xor

from firmware_host.images import FLASH_BYTES, FLASH_START

_ACK, _NACK, _SYNC = 0x79, 0x1F, 0x7F
_COMMANDS = bytes([0x00, 0x01, 0x02, 0x11, 0x21, 0x31, 0x44, 0x63, 0x73, 0x82, 0x92])
_SECTOR_KIB = (16, 16, 16, 16, 64, 128, 128, 128, 128, 128, 128, 128)
_OPTIONS = 0x1FFF_C000


class RomEmulator:
    """Takes bytes, answers bytes; its flash, 1 MiB, only loses ones until it is erased.

    What it was told: `erased` has the sectors, in order, `started` where GO went, and `resets` counts those
    because of new option bytes.
    """

    def __init__(self, flash=None, protected=False, product=0x413):
        self.flash = bytearray(b"\xff" * FLASH_BYTES if flash is None else flash)
        self.options = bytearray.fromhex("edaa0000000000000fff000000000000")
        self.protected, self.product = protected, product
        self.erased = []
        self.started = None
        self.resets = 0
        self._out = bytearray()
        self._run = self._sessions()
        next(self._run)

    def receive(self, data):
        """Bytes from the host; gives what is answered."""
        for byte in data:
            if self.started is None:
                self._run.send(byte)
        out, self._out = bytes(self._out), bytearray()
        return out

    def _take(self, count):
        data = bytearray()
        while len(data) < count:
            data.append((yield))
        return bytes(data)

    def _sessions(self):
        while True:
            while (yield from self._take(1))[0] != _SYNC:
                pass
            self._out.append(_ACK)
            resets = self.resets
            while self.resets == resets:
                code, inverse = yield from self._take(2)
                if code != inverse ^ 0xFF or code not in _COMMANDS or (self.protected and code > 0x02):
                    self._out.append(_NACK)
                    continue
                self._out.append(_ACK)
                good = yield from self._command(code)
                if good is not None:
                    self._out.append(_ACK if good else _NACK)

    def _command(self, code):
        """Whether it was done, to be said; None: said already."""
        if code == 0x00:
            self._out += bytes([len(_COMMANDS), 0x31]) + _COMMANDS
            return True
        if code == 0x02:
            self._out += b"\x01" + self.product.to_bytes(2, "big")
            return True
        if code == 0x44:
            return (yield from self._erase())
        place = yield from self._take(5)
        address = int.from_bytes(place[:4], "big")
        if _sum(place) or self._memory(address, 1) is None:
            return False
        if code == 0x21:
            self.started = address
            return True
        self._out.append(_ACK)
        if code == 0x11:
            count, inverse = yield from self._take(2)
            found = self._memory(address, count + 1)
            if count != inverse ^ 0xFF or found is None:
                return False
            memory, at = found
            self._out += bytes([_ACK]) + memory[at : at + count + 1]
            return None
        return (yield from self._write(address)) if code == 0x31 else False

    def _write(self, address):
        head = yield from self._take(1)
        body = yield from self._take(head[0] + 2)
        data = body[:-1]
        found = self._memory(address, len(data))
        if _sum(head + body) or len(data) % 4 or address % 4 or found is None:
            return False
        memory, at = found
        if memory is self.options:
            memory[at : at + len(data)] = data
            self.resets += 1
        else:
            for n, byte in enumerate(data):
                memory[at + n] &= byte
        return True

    def _erase(self):
        head = yield from self._take(2)
        body = yield from self._take(2 * (int.from_bytes(head, "big") + 1) + 1)
        sectors = [int.from_bytes(body[n : n + 2], "big") for n in range(0, len(body) - 1, 2)]
        if _sum(head + body) or max(sectors) >= len(_SECTOR_KIB):
            return False
        for sector in sectors:
            start, size = sum(_SECTOR_KIB[:sector]) << 10, _SECTOR_KIB[sector] << 10
            self.flash[start : start + size] = b"\xff" * size
            self.erased.append(sector)
        return True

    def _memory(self, address, count):
        for start, memory in ((FLASH_START, self.flash), (_OPTIONS, self.options)):
            if start <= address and address + count <= start + len(memory):
                return memory, address - start
        return None


def _sum(data):
    return reduce(xor, data, 0)


class RomLine:
    """A line to the emulator, as a `Transport`; a byte takes eleven bits."""

    def __init__(self, rom, baud=115_200):
        self.name = "rom:"
        self.rom = rom
        self._byte_s = 11 / baud
        self._now = 0.0
        self._out = b""

    def time_s(self):
        """Time of the line, s."""
        return self._now

    def to_part(self, data):
        """What of `data` arrives at the part; here everything."""
        return data

    to_host = to_part

    def read(self, timeout_s):
        """Bytes of the part; or time passes."""
        out, self._out = self._out, b""
        self._now += self._byte_s * len(out) if out else max(timeout_s, 1e-4)
        return out

    def write(self, data):
        """Bytes to the part."""
        self._now += self._byte_s * len(data)
        self._out += self.to_host(self.rom.receive(self.to_part(data)))

    def close(self):
        """Nothing to let go."""
