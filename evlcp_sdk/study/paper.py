"""The figures of arXiv 2510.17203 that a campaign is held against."""

from dataclasses import dataclass
from typing import Literal

PAPER_NAME = "arXiv 2510.17203"

Measure = Literal["ber", "rmse_m", "gross_share"]


@dataclass(frozen=True)
class Reference:
    """A figure of the paper, measured on real drives past a bar 1.5 m aside.

    Attributes:
        measure: Bit error rate, distance RMSE in m, or share of distance errors of half a metre or more.
        clusters: Clusters that the distance is measured from: 16, or the 2 of the method it compares with;
            None where it does not matter.
        speed_kmh: Speed of the car; None for 20, 30 and 40 km/h alike.
        from_m: Start of the distances it holds for, m.
        to_m: Their end, m.
        value: The figure.
        bound: The paper gives it as an upper bound.
    """

    measure: Measure
    clusters: int | None
    speed_kmh: float | None
    from_m: int
    to_m: int
    value: float
    bound: bool = False


PAPER = (
    Reference("ber", 16, None, 30, 100, 0.01, bound=True),
    Reference("rmse_m", 16, 30.0, 30, 40, 0.0702),
    Reference("rmse_m", 16, 30.0, 40, 50, 0.1216),
    Reference("rmse_m", 16, 30.0, 50, 60, 0.20, bound=True),
    Reference("rmse_m", 16, 30.0, 60, 100, 0.75, bound=True),
    Reference("rmse_m", 2, 30.0, 30, 40, 0.2819),
    Reference("rmse_m", 2, 30.0, 40, 50, 0.4182),
    Reference("gross_share", 16, 30.0, 30, 60, 0.004),
)
"""Every figure of the paper that a simulated drive can be held against."""
