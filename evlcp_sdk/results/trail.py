"""The smoothed trajectory as lines on a map."""

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise

from evlcp_sdk.place.navigator import Settled

Line = list[list[float]]
"""Points [longitude in degrees, latitude in degrees, height in m]."""


class Trail:
    """Puts smoothed places together to lines as they come: one per trajectory, going on where it ended."""

    def __init__(self) -> None:
        self._end: Line = []

    def lines(self, settled: Sequence[Settled]) -> Iterator[Line]:
        """The lines that some more places make, of two points or more, none across the 180th meridian."""
        whole, line = [], self._end
        for one in settled:
            if one.filtered.starts and line:
                whole.append(line)
                line = []
            place = one.smoothed
            line.append(
                [round(place.longitude_deg, 9), round(place.latitude_deg, 9), round(place.height_m, 4)]
            )
        self._end = line[-1:]
        for one_line in (*whole, line):
            yield from (piece for piece in cut(one_line) if len(piece) > 1)


def cut(line: list[list[float]]) -> list[list[list[float]]]:
    """A line in pieces that do not cross the 180th meridian (RFC 7946, 3.1.9)."""
    pieces = [line[:1]]
    for here, there in pairwise(line):
        turn = there[0] - here[0]
        if abs(turn) > 180:
            edge = math.copysign(180.0, here[0])
            share = (edge - here[0]) / (turn - math.copysign(360.0, turn))
            at = [round(a + share * (b - a), 9) for a, b in zip(here[1:], there[1:], strict=True)]
            pieces[-1].append([edge, *at])
            pieces.append([[-edge, *at]])
        pieces[-1].append(there)
    return pieces
