"""Flicker and balance of a chip table.

IEEE Std 1789-2015 bounds the modulation of the light below 3 kHz: no observable effect (practice 2) up to
Mod% = f / 30 for 90 Hz to 3 kHz and 0.01 f below 90 Hz; low risk (practice 1) up to 0.08 f for 90 Hz to
1250 Hz and 0.025 f below 90 Hz. Above 3 kHz there is no bound, and from 1250 Hz none at low risk.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.codebook import longest_run

Floats = NDArray[np.floating[Any]]

LIMIT_HZ = 3000.0
"""Above this frequency the recommendation sets no bound."""

NO_EFFECT = (0.01, 1 / 30, LIMIT_HZ)
LOW_RISK = (0.025, 0.08, 1250.0)
"""Modulation in percent a hertz below 90 Hz and from there on, and the frequency above which none is set."""


@dataclass(frozen=True)
class ClusterFlicker:
    """One cluster's light.

    Attributes:
        cluster: Its number.
        on_share: Share of chips that are on.
        longest_run: Longest run of equal chips in the repeated table.
        line_hz: Frequency of the worst line below 3 kHz.
        line_percent: Its modulation, percent of the mean light (sine of amplitude A on mean M: 100 A / M).
        limit_percent: Largest modulation without observable effect at that frequency; infinite if there is no
            line below 3 kHz.
        low_risk: Whether every line is within the low-risk bound.
        no_effect: Whether every line is within the no-effect bound.
    """

    cluster: int
    on_share: float
    longest_run: int
    line_hz: float
    line_percent: float
    limit_percent: float
    low_risk: bool
    no_effect: bool

    def to_dict(self) -> dict[str, Any]:
        """The fields as plain values; an infinite limit is None, as JSON has no such number."""
        limit = self.limit_percent if math.isfinite(self.limit_percent) else None
        return asdict(self) | {"limit_percent": limit}


def bound_percent(frequency_hz: Floats, bound: tuple[float, float, float]) -> Floats:
    """Largest modulation within a bound at frequencies in Hz, percent.

    >>> bound_percent(np.array([60.0, 1200.0, 4000.0]), NO_EFFECT).round(2).tolist()
    [0.6, 40.0, inf]
    >>> bound_percent(np.array([60.0, 1000.0, 1300.0]), LOW_RISK).round(2).tolist()
    [1.5, 80.0, inf]
    """
    below, above, end_hz = bound
    percent = np.where(frequency_hz < 90.0, below, above) * frequency_hz
    return np.where(frequency_hz > end_hz, np.inf, percent)


def measure_flicker(chips: NDArray[np.uint8], chip_rate_hz: float) -> list[ClusterFlicker]:
    """Balance, runs and spectral lines of a chip table that repeats, uint8 (chips, clusters).

    The light of the repeated table has lines at multiples of chip_rate / chips. A chip is a rectangle, which
    attenuates a line at f by sinc(f / chip_rate).

    >>> table = np.tile([[0], [1]], (100, 1)).astype(np.uint8)
    >>> measure_flicker(table, 10_000.0)[0].line_percent
    0.0
    """
    n = len(chips)
    frequency = np.fft.rfftfreq(n, 1.0 / chip_rate_hz)
    spectrum = np.abs(np.fft.rfft(chips.astype(np.float64), axis=0)) / n
    amplitude = 2.0 * spectrum * np.sinc(frequency / chip_rate_hz)[:, None]
    low = (frequency > 0) & (frequency <= LIMIT_HZ)
    share = chips.mean(axis=0)
    percent = 100.0 * amplitude[low] / np.where(share, share, np.inf)
    percent[percent < 1e-9] = 0.0
    # a line without modulation, in case there is none
    percent = np.vstack([percent, np.zeros(len(share))])
    line_hz = np.append(frequency[low], 0.0)
    bound = np.append(bound_percent(frequency[low], NO_EFFECT), np.inf)
    risk = np.append(bound_percent(frequency[low], LOW_RISK), np.inf)
    worst = np.argmax(percent / bound[:, None], axis=0)
    return [
        ClusterFlicker(
            cluster=k,
            on_share=float(share[k]),
            longest_run=longest_run(chips[:, k]),
            line_hz=float(line_hz[w]),
            line_percent=float(percent[w, k]),
            limit_percent=float(bound[w]),
            low_risk=bool((percent[:, k] <= risk).all()),
            no_effect=bool((percent[:, k] <= bound).all()),
        )
        for k, w in enumerate(worst)
    ]
