"""From when until when the light of each transmitter was there."""

_MOST = 1024
"""Transmitters that are remembered: those seen last."""


class LitTimes:
    """Remembers of each transmitter its first and its last frame in which its light was there.

    Attributes:
        by_number: Transmitter number to start of the first and of the last such frame, camera clock, us.

    >>> lit = LitTimes()
    >>> lit.note(3, 500.0, 500.0)
    >>> lit.note(3, 500.0, 3700.0)
    >>> lit.by_number
    {3: (500.0, 3700.0)}
    """

    def __init__(self) -> None:
        self.by_number: dict[int, tuple[float, float]] = {}

    def note(self, number: int, first_us: float, start_us: float) -> None:
        """Take a frame: when it starts, and when the first one did if the transmitter is new."""
        first_us, _ = self.by_number.pop(number, (first_us, start_us))
        self.by_number[number] = (first_us, start_us)
        if len(self.by_number) > _MOST:
            del self.by_number[next(iter(self.by_number))]
