"""Frames to packets."""

from evlcp_sdk.values import Frame, Packet, changed


class PacketAssembler:
    """Collects a transmitter's frames until their packet is over.

    A packet is a reflection as a whole, as its last frame, which knows most, says.

    Args:
        sent: Frames of a packet.
    """

    def __init__(self, sent: int) -> None:
        self._sent = sent
        self._frames: list[Frame] = []
        self._start: tuple[float, float] = (0.0, 0.0)

    def add(self, frame: Frame, packet_t_us: float, chip_us: float) -> list[Packet]:
        """Take a frame; return the packet before it, if this frame starts another."""
        done = self.flush() if self._frames and self._frames[-1].packet != frame.packet else []
        if not self._frames:
            self._start = (packet_t_us, chip_us)
        self._frames.append(frame)
        return done + (self.flush() if frame.frame == self._sent - 1 else [])

    def flush(self) -> list[Packet]:
        """The packet of the frames held, if any."""
        if not self._frames:
            return []
        first, echo_of = self._frames[0], self._frames[-1].echo_of
        frames = [f if f.echo_of == echo_of else changed(f, echo_of=echo_of) for f in self._frames]
        packet = Packet(first.transmitter, first.packet, *self._start, tuple(frames), self._sent)
        self._frames = []
        return [packet]
