"""A board behind a USB bridge."""

from collections import deque

from firmware_host.emulators.simulated import SimulatedLine
from firmware_host.protocol.generated.requests import DEFAULT_BAUD


class UsbLine(SimulatedLine):
    """A line of `baud` behind a USB bridge, which keeps what the board sends for `latency_s`, its timer.

    What the host sends USB keeps for `frame_s`, a full-speed frame.
    """

    def __init__(self, board, latency_s, baud=DEFAULT_BAUD, frame_s=0.0, name="simulated USB:"):
        super().__init__(board, name, step_us=20)
        self._byte_us = 10e6 / baud
        self._latency_us = latency_s * 1e6
        self._frame_us = frame_s * 1e6
        self._out = deque()
        self._in = deque()
        self._out_free_us = 0.0
        self._in_free_us = 0.0

    def write(self, data):
        """Bytes to the board, one after the other at the line's rate."""
        at = max(self.board.now_us + self._frame_us, self._out_free_us)
        for byte in data:
            at += self._byte_us
            self._out.append((at, bytes([byte])))
        self._out_free_us = at

    def read(self, timeout_s):
        """Bytes from the board, once they have come over the line and the bridge lets go of them."""
        end = self.board.now_us + max(self.step_us, int(timeout_s * 1e6))
        while True:
            while self._out and self._out[0][0] <= self.board.now_us:
                self.board.receive(self._out.popleft()[1])
            sent = self.board.take_output()
            if sent:
                self._in_free_us = max(self.board.now_us, self._in_free_us) + len(sent) * self._byte_us
                self._in.append((self._in_free_us + self._latency_us, sent))
            found = b""
            while self._in and self._in[0][0] <= self.board.now_us:
                found += self._in.popleft()[1]
            if found or self.board.now_us >= end:
                return found
            self.board.run(self.step_us)
