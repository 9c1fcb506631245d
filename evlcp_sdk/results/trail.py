"""The smoothed trajectory as lines on a map."""

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise

from evlcp_sdk.place.navigator import Settled

Line = list[list[float]]
"""Points [longitude in degrees, latitude in degrees, height in m]."""


class Trail:
    """Joins smoothed places to lines as they come: one per trajectory, continued from call to call."""

    def __init__(self) -> None:
        self._end: Line = []

    def lines(self, settled: Sequence[Settled]) -> Iterator[Line]:
        """The lines of the next places, of two points or more, none across the 180th meridian."""
        complete, line = [], self._end
        for fix in settled:
            if fix.filtered.starts:
                complete.append(line)
                line = []
            place = fix.smoothed
            line.append(
                [round(place.longitude_deg, 9), round(place.latitude_deg, 9), round(place.height_m, 4)]
            )
        self._end = line[-1:]
        for path in (*complete, line):
            yield from (piece for piece in split_at_antimeridian(path) if len(piece) > 1)


def split_at_antimeridian(line: Line) -> list[Line]:
    """Split a line into pieces that do not cross the 180th meridian (RFC 7946, 3.1.9)."""
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
