"""An EVK4 on an emulated USB bus: run by the system's Python, which has GObject introspection and umockdev.

It answers what libusb asks the kernel for a device of the driver `neuromorphic-drivers`: control requests,
registers (endpoints 0x02 and 0x82), and events, EVT3 words, on 0x81 once output is on. Its first line is the
folder for `UMOCKDEV_DIR`; a program with that and `LD_PRELOAD=libumockdev-preload.so.0` sees the camera.
Further lines tell what happens: `open`, `sent`, `unplugged`, `let go` once all that was in flight is given
back, `plugged`, and `register ADDRESS VALUE` for those of --tell. Commands on stdin, a line each: `unplug`,
`plug`, `end`.
"""

import argparse
import struct
import sys
import threading
import time
from collections import deque
from pathlib import Path

GLib = UMockdev = None

SUBMIT, REAP, REAP_NDELAY, DISCARD = 0x8038550A, 0x4008550C, 0x4008550D, 0x550B
CAPABILITIES, GET_DRIVER, CLAIM, RELEASE, SPEED = 0x8004551A, 0x41045508, 0x8004550F, 0x80045510, 0x551F
EAGAIN, ENODEV, ENOTTY, ENODATA, EINVAL, ENOENT, ESHUTDOWN = 11, 19, 25, 61, 22, 2, 108
NODE = "/dev/bus/usb/001/002"
QUEUED = 32
"""Transfers that the driver queues before it reads events."""

OUTPUT, OUTPUT_OFF = 0x9028, 1 << 1
ADC_STATUS, ADC_DONE, ADC_DEGREES_30 = 0x0050, 1 << 11, 453
BIASES = {0x1000: 0x7C, 0x1004: 0x53, 0x100C: 0, 0x1010: 0x66, 0x1014: 0x4D, 0x1018: 0x49, 0x101C: 0x5B}
BIASES |= {0x1020: 0x14, 0x1040: 0x8C, 0x1044: 0x7C, 0x1048: 0x94, 0x104C: 0x74, 0x1050: 0x51}


def string(text):
    return bytes([2 + 2 * len(text), 3]) + text.encode("utf-16-le")


STRINGS = {0: b"\x04\x03\x09\x04", 1: string("Prophesee"), 2: string("EVK4")}


def descriptors():
    device = struct.pack("<BBHBBBBHHHBBBB", 18, 1, 0x0300, 0, 0, 0, 9, 0x04B4, 0x00F5, 0x0100, 1, 2, 0, 1)
    ends = b""
    for address in (0x81, 0x82, 0x02):
        ends += struct.pack("<BBBBHB", 7, 5, address, 2, 1024, 0) + struct.pack("<BBBBH", 6, 0x30, 15, 0, 0)
    interface = struct.pack("<BBBBBBBBB", 9, 4, 0, 0, 3, 0xFF, 0, 0, 0)
    config = struct.pack("<BBHBBBBB", 9, 2, 9 + len(interface) + len(ends), 1, 1, 0, 0x80, 100)
    return device + config + interface + ends


DESCRIPTION = f"""\
P: /devices/pci0000:00/usb1/1-1
N: {NODE.removeprefix("/dev/")}
E: DEVNAME={NODE}
E: DEVTYPE=usb_device
E: SUBSYSTEM=usb
E: BUSNUM=001
E: DEVNUM=002
A: busnum=1\\n
A: devnum=2\\n
A: bConfigurationValue=1\\n
A: speed=5000\\n
A: idVendor=04b4\\n
A: idProduct=00f5\\n
H: descriptors={descriptors().hex().upper()}

"""


class Camera:
    def __init__(self, words, rate, chunk, tell, then):
        self.words, self.rate, self.chunk, self.tell, self.then = words, rate, chunk, tell, then
        self.registers = dict(BIASES)
        self.registers[OUTPUT] = OUTPUT_OFF
        self.waiting = deque()
        self.done = deque()
        self.answers = deque()
        self.gone = self.let_go = False
        self.sent = 0
        self.since = None
        self.opened = False

    def say(self, *what):
        print(*what, flush=True)

    def handle(self, client):
        if not self.opened:
            self.opened = True
            self.say("open")
        request = client.get_request() & 0xFFFFFFFF
        if self.gone and not (self.done and request in (REAP, REAP_NDELAY)):
            if not self.done and not self.let_go:
                self.let_go = True
                self.say("let go")
            client.complete(-1, ENODEV)
            return True
        if request == SUBMIT:
            self.submit(client.get_arg().resolve(0, 56))
            client.complete(0, 0)
        elif request in (REAP, REAP_NDELAY):
            self.reap(client)
        elif request == DISCARD:
            (address,) = struct.unpack("<Q", bytes(client.get_arg().retrieve()))
            found = next((one for one in self.waiting if one[0].client_addr == address), None)
            if found:
                self.waiting.remove(found)
                self.done.append((found, b"", -ENOENT))
            client.complete(*((0, 0) if found else (-1, EINVAL)))
        else:
            if request == CAPABILITIES:
                client.get_arg().resolve(0, 4).update(0, struct.pack("<I", 0x01 | 0x04 | 0x10))
            other = (0, 0) if request >> 8 & 0xFF == ord("U") else (-1, ENOTTY)
            client.complete(*{GET_DRIVER: (-1, ENODATA), SPEED: (5, 0)}.get(request, other))
        return True

    def submit(self, urb):
        kind, endpoint = bytes(urb.retrieve())[:2]
        (length,) = struct.unpack_from("<i", bytes(urb.retrieve()), 24)
        one = urb, endpoint, length
        if kind == 2:
            setup = bytes(urb.resolve(16, length).retrieve())
            self.done.append((one, self.control(setup), 0))
        elif endpoint == 0x02:
            data = bytes(urb.resolve(16, length).retrieve())
            self.answers.append(self.answer(data))
            self.done.append((one, data, 0))
        elif endpoint == 0x82:
            self.done.append((one, self.answers.popleft() if self.answers else b"", 0))
        elif self.registers[OUTPUT] & OUTPUT_OFF:
            self.done.append((one, b"", 0))
        else:
            self.waiting.append(one)

    def control(self, setup):
        kind, request, value, _index, length = struct.unpack_from("<BBHHH", setup)
        if kind == 0xC0 and request == 0x72:
            data = b"\x31\x00"
        elif kind & 0x80 and request == 6 and value >> 8 == 3:
            data = STRINGS.get(value & 0xFF, b"\x02\x03")
        else:
            data = b""
        return setup[:8] + data[:length]

    def answer(self, data):
        if data[:3] == b"\x02\x01\x01" and len(data) >= 20:
            address, value = struct.unpack_from("<II", data, 12)
            if data[3] == 0x40:
                self.registers[address] = value
                if address in self.tell:
                    self.say("register", f"{address:#06x}", f"{value:#010x}")
                return data[:20]
            value = ADC_DONE | ADC_DEGREES_30 if address == ADC_STATUS else self.registers.get(address, 0)
            return data[:16] + struct.pack("<I", value)
        if data[0] == 0x72:
            return data[:8] + bytes.fromhex("78563412") + bytes(4)
        return data[:8] + bytes(8)

    def stream(self):
        """Fill the transfers that wait with what is due."""
        if self.registers[OUTPUT] & OUTPUT_OFF or not self.waiting:
            return
        if self.since is None:
            if len(self.waiting) < QUEUED:
                return
            self.since = time.monotonic()
        due = len(self.words) if not self.rate else int((time.monotonic() - self.since) * self.rate)
        due = min(due, len(self.words)) & ~1
        while self.waiting and self.sent < due:
            one = self.waiting.popleft()
            data = self.words[self.sent : min(self.sent + min(one[2], self.chunk), due)]
            self.sent += len(data)
            self.done.append((one, data, 0))
            if self.sent == len(self.words):
                self.say("sent", self.sent)
                if self.then == "unplug":
                    GLib.timeout_add(300, self.unplug)

    def reap(self, client):
        if not self.done:
            self.stream()
        if not self.done:
            if self.since is None:
                client.complete(-1, EAGAIN)
            else:
                # The node is always readable: who asks for nothing waits a little, or would do nothing else.
                GLib.timeout_add(1, lambda: client.complete(-1, ENODEV if self.gone else EAGAIN))
            return
        (urb, endpoint, _length), data, status = self.done.popleft()
        if data:
            urb.resolve(16, len(data)).update(0, data)
        # A control transfer begins with its set-up.
        size = max(len(data) - 8, 0) if endpoint in (0x80, 0x00) else len(data)
        urb.update(4, struct.pack("<i", status))
        urb.update(28, struct.pack("<i", size))
        client.get_arg().resolve(0, 8).set_ptr(0, urb)
        client.complete(0, 0)

    def unplug(self):
        # What waits is given back, as the kernel does.
        self.gone = True
        self.done.extend((one, b"", -ESHUTDOWN) for one in self.waiting)
        self.waiting.clear()
        self.say("unplugged")


class Port:
    """Where a camera is plugged in: who opened one that is gone never sees the next, as with the kernel."""

    def __init__(self, made):
        self.made = made
        self.camera = made()
        self.opened = {}

    def handle(self, _base, client):
        return self.opened.setdefault(client, self.camera).handle(client)

    def vanished(self, _base, client):
        self.opened.pop(client, None)

    def unplug(self):
        self.camera.unplug()

    def plug(self):
        self.camera = self.made()
        self.camera.say("plugged")


def main():
    global GLib, UMockdev
    import gi

    gi.require_version("UMockdev", "1.0")
    from gi.repository import GLib, UMockdev

    options = argparse.ArgumentParser()
    options.add_argument("words", help="a file of EVT3 words, no header")
    options.add_argument("--rate", type=float, default=0, help="bytes a second; 0: as fast as they are read")
    options.add_argument("--chunk", type=int, default=1 << 17, help="most bytes of a transfer")
    options.add_argument("--then", default="wait", choices=("wait", "unplug"))
    options.add_argument("--tell", default="", help="addresses of registers whose writes are told, by commas")
    given = options.parse_args()
    words = Path(given.words).read_bytes()
    tell = {int(address, 16) for address in given.tell.split(",") if address}
    testbed = UMockdev.Testbed.new()
    testbed.add_from_string(DESCRIPTION)
    port = Port(lambda: Camera(words, given.rate, given.chunk, tell, given.then))
    handler = UMockdev.IoctlBase()
    handler.connect("handle-ioctl", port.handle)
    handler.connect("client-vanished", port.vanished)
    testbed.attach_ioctl(NODE, handler)
    loop = GLib.MainLoop()
    print(testbed.get_root_dir(), flush=True)

    def listen():
        for line in sys.stdin:
            action = {"unplug": port.unplug, "plug": port.plug}.get(line.strip())
            if action is None:
                break
            GLib.idle_add(lambda action=action: action() and False)
        GLib.idle_add(loop.quit)

    threading.Thread(target=listen, daemon=True).start()
    loop.run()


if __name__ == "__main__":
    main()
