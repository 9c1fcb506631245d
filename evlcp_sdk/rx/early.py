"""Frames of several links, told before their packets are judged, as soon as that is no guess."""

from collections import OrderedDict, deque
from collections.abc import Callable

from evlcp_sdk.values import Frame, Packet

_MOST_TRANSMITTERS = 1024
_MOST_FRAMES = 4096
"""Of a transmitter that wait for a judgement; of more, the oldest come with their packet or not at all."""


class EarlyFrames:
    """Tells frames in order: those of a transmitter that holds its place at once, others with their packet.

    Args:
        tell: Gets each frame once; None for nobody.

    Attributes:
        withdrawn: Frames that were told, of packets that another link took later.
    """

    def __init__(self, tell: Callable[[Frame], None] | None) -> None:
        self._tell = tell
        self._waiting: OrderedDict[int, deque[Frame]] = OrderedDict()
        self._told: dict[int, deque[tuple[int, int]]] = {}
        self.withdrawn = 0

    def decoded(self, frame: Frame, *, owns: bool) -> None:
        """Take a frame, in order of its transmitter's.

        Args:
            frame: The frame, on the camera's clock.
            owns: Its transmitter owns its place now.
        """
        number = frame.transmitter
        if number not in self._waiting:
            self._waiting[number] = deque(maxlen=_MOST_FRAMES)
            self._told[number] = deque(maxlen=_MOST_FRAMES)
        self._waiting.move_to_end(number)
        while len(self._waiting) > _MOST_TRANSMITTERS:
            gone, _ = self._waiting.popitem(last=False)
            del self._told[gone]
        self._waiting[number].append(frame)
        if owns:
            self._tell_waiting(number)

    def given(self, packet: Packet, *, owns: bool) -> None:
        """Take a packet that is given: tell those of its frames that were not; all that wait if it holds."""
        if self._tell is None:
            return
        told = self._forget(packet)
        for frame in packet.frames:
            if (frame.packet, frame.frame) not in told:
                self._tell(frame)
        if owns and packet.transmitter in self._waiting:
            self._tell_waiting(packet.transmitter)

    def refused(self, packet: Packet) -> None:
        """Take a packet that is not given: its frames are not told any more."""
        self.withdrawn += len(self._forget(packet))

    def _tell_waiting(self, number: int) -> None:
        assert self._tell is not None
        waiting, told = self._waiting[number], self._told[number]
        while waiting:
            frame = waiting.popleft()
            told.append((frame.packet, frame.frame))
            self._tell(frame)

    def _forget(self, packet: Packet) -> set[tuple[int, int]]:
        """Let go what is known of a packet's frames, and of earlier ones; give those of it that were told."""
        number = packet.transmitter
        if number not in self._waiting:
            return set()
        waiting, told = self._waiting[number], self._told[number]
        while waiting and waiting[0].packet <= packet.packet:
            waiting.popleft()
        mine = set()
        while told and told[0][0] <= packet.packet:
            one = told.popleft()
            if one[0] == packet.packet:
                mine.add(one)
        return mine
