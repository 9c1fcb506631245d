"""Packet timing by sliding correlation with the preamble."""

from dataclasses import dataclass, field, replace
from statistics import fmean
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_sdk.air.codebook import Codebook, chips_of_values
from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.plugin.roles import Synchronization
from evlcp_sdk.values import SyncLock

__all__ = ["BarkerSync"]

_GUARD_CHIPS = 3
"""A correlation peak stands alone within this distance: a Manchester-coded preamble has its high sidelobes
one and two chips away."""

_TIMING_SIGMA_US = 2.0
"""Spread of one packet's time, from the grid of the correlation and the jitter of the pixels."""

_CLEARLY = 0.1
"""Difference in correlation that separates a preamble from data: from packet to packet it varies by 0.02."""

_FIT_PACKETS = 8
"""Packets of the clock fit: 0.3 s, in which a quartz does not drift by 0.1 us."""


@dataclass(frozen=True)
class BarkerSync(Synchronization):
    """Preamble correlation at sub-chip steps, then a clock fitted to the packets heard.

    In a preamble all clusters blink in phase; in pilots they cancel, and in info segments they differ. So the
    signed events of a whole region, summed over windows of one chip, correlate with the preamble's chips
    there and nowhere else. Positive and negative events come with different delays, which are
    measured apart at every packet.
    """

    steps_per_chip: Annotated[int, Field(ge=4, le=100, description="Correlation steps in a chip.")] = 10
    min_correlation: Annotated[
        float,
        Field(
            gt=0,
            lt=1,
            description="Normalised correlation that makes a preamble; random data on 16 clusters have"
            " 0.07 rms, a preamble 0.7 or more.",
        ),
    ] = 0.5
    min_events: Annotated[int, Field(ge=26, description="Events in a preamble that count as heard.")] = 100
    clock_tolerance_ppm: Annotated[
        float, Field(gt=0, le=10_000, description="How far apart the two clocks may be.")
    ] = 100.0
    on_grid_chips: Annotated[
        float, Field(gt=0, lt=1, description="How far from its expected time a preamble keeps the lock.")
    ] = 0.3

    def compile(self, codebook: Codebook, packet: PacketFormat) -> "BarkerSynchronizer":
        """Precompute the correlation's weights."""
        return BarkerSynchronizer(self, codebook, packet)


@dataclass(frozen=True)
class _Heard:
    """One preamble: its number since the first of this lock, and its times, us."""

    packet: int
    on_us: float
    off_us: float
    onset_us: float
    quality: float


@dataclass(frozen=True, eq=False)
class SyncState:
    """What synchronization remembers: recent event counts (OFF, ON) a step, and the preambles of its lock."""

    first_bin: int | None = None
    counts: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, 0)))
    next_bin: int = 0
    heard: tuple[_Heard, ...] = ()
    stray: _Heard | None = None


class BarkerSynchronizer:
    """`BarkerSync` for one codebook and packet format; pure but for what `step` is given."""

    def __init__(self, spec: BarkerSync, codebook: Codebook, packet: PacketFormat) -> None:
        self._spec = spec
        self._packet = packet
        self._chips = 2.0 * chips_of_values(codebook.preamble) - 1
        self._bin_us = packet.chip_us / spec.steps_per_chip
        # A sum over chips of a window's count is a difference of the running count at the chips' bounds.
        padded = np.concatenate([[0.0], self._chips, [0.0]])
        self._weights = padded[:-1] - padded[1:]
        self._rising = np.flatnonzero(np.diff(self._chips) > 0) + 1

    def init(self) -> SyncState:
        """State before the first event."""
        return SyncState()

    def step(
        self, state: SyncState, t_us: NDArray[np.int64], p: NDArray[np.uint8], until_us: int
    ) -> tuple[SyncState, list[SyncLock]]:
        """Count events, correlate what is complete, give a lock for each preamble (see `Synchronizer`)."""
        from evlcp_barker import _kernels

        n = self._spec.steps_per_chip
        span = n * len(self._chips)
        guard = n * _GUARD_CHIPS
        until_bin = int(until_us // self._bin_us)
        if state.first_bin is None:
            # A preamble starts with a dark chip: the first event may already be the edge at its end.
            first = (int(t_us[0] // self._bin_us) if len(t_us) else until_bin) - guard
            state = replace(state, first_bin=first, next_bin=first)
        assert state.first_bin is not None
        bins = max(until_bin - state.first_bin, state.counts.shape[1] - 1)
        # The last bin is still open: its events count, but it is not correlated yet.
        counts = np.empty((2, bins + 1))
        _kernels.count_bins(t_us, p, state.first_bin, self._bin_us, state.counts, counts)

        locks: list[SyncLock] = []
        heard, stray = state.heard, state.stray
        lags = bins - span + 1
        lo = state.next_bin - state.first_bin
        if lags - guard > lo:
            rho = np.empty(lags)
            top = _kernels.correlate(counts[:, :bins], self._chips, n, self._spec.min_events, rho)
            for lag in self._peaks(rho, lo, guard) if top >= self._spec.min_correlation else ():
                found = self._refine(lag, counts, state.first_bin, float(rho[lag]))
                heard, stray = self._accept(heard, stray, found)
                if stray is None:
                    locks.append(self._lock(heard))
            lo = lags - guard
        drop = max(lo - guard, 0)
        first = state.first_bin + drop
        return SyncState(first, counts[:, drop:], state.first_bin + lo, heard, stray), locks

    def _peaks(self, rho: NDArray[np.float64], lo: int, guard: int) -> list[int]:
        """Lags from `lo` on that correlate best within `guard` on both sides; the first of equals."""
        high = lo + np.flatnonzero(rho[lo : len(rho) - guard] >= self._spec.min_correlation)
        return [lag for lag in high.tolist() if lag == _first_maximum(rho, lag - guard, lag + guard + 1)]

    def _refine(self, lag: int, counts: NDArray[np.float64], first_bin: int, quality: float) -> _Heard:
        """Times of one preamble, for positive and negative events apart, us."""
        n = self._spec.steps_per_chip
        start = max(lag - n, 0)
        stop = min(lag + n + 1, counts.shape[1] - n * len(self._chips) + 1)

        bounds = np.arange(start, stop)[:, None] + n * np.arange(len(self._chips) + 1)

        def centre(count: NDArray[np.float64], sign: float) -> float:
            running = np.concatenate([[0.0], np.cumsum(count)])
            part = sign * (running[bounds] @ self._weights)
            # The top is flat where a window holds all events of an edge: its middle is the best window.
            weight = np.maximum(part - 0.9 * part.max(), 0) if part.max() > 0 else np.zeros(len(part))
            if weight.sum() == 0:
                return float(lag)
            return start + float(weight @ np.arange(len(part)) / weight.sum())

        off, on = counts
        middle_on, middle_off = centre(on, 1), centre(off, -1)
        # The onset of the positive events, averaged over the rising edges inside the preamble.
        edges = lag + n * self._rising
        steps = np.arange(-n, n)
        response = on[np.clip(edges[:, None] + steps, 0, len(on) - 1)].sum(0)
        half = response.max() / 2
        k = int(np.argmax(response >= half))
        below = response[k - 1] if k else 0.0
        rise = (half - below) / (response[k] - below) if response[k] > below else 0.0
        onset = lag + float(steps[k]) - 0.5 + rise
        at = [(first_bin + v) * self._bin_us for v in (middle_on, middle_off, onset)]
        return _Heard(0, at[0], at[1], at[2], quality)

    def _accept(
        self, heard: tuple[_Heard, ...], stray: _Heard | None, found: _Heard
    ) -> tuple[tuple[_Heard, ...], _Heard | None]:
        """Add a preamble to the lock it fits; a better one, or a second one as good, off it starts anew.

        One symbol on all clusters at once blinks in phase, too, but can agree with 16 chips of 26 only.
        """
        quality = float(np.mean([h.quality for h in heard])) if heard else 0.0
        if found.quality > quality + _CLEARLY:
            return (found,), None
        steps = self._packets_between(heard, found)
        if steps is not None:
            return (*heard, replace(found, packet=heard[-1].packet + steps))[-_FIT_PACKETS:], None
        if found.quality < quality - _CLEARLY:
            return heard, stray
        if stray is not None:
            steps = self._packets_between((stray,), found)
            if steps is not None:
                return (stray, replace(found, packet=steps)), None
        return heard, found

    def _packets_between(self, heard: tuple[_Heard, ...], found: _Heard) -> int | None:
        """Whole packets from the last of a lock to another preamble, None if it is off the grid."""
        _, chip_us = self._fit(heard)
        period = self._packet.packet_chips * chip_us
        apart = found.on_us - heard[-1].on_us
        steps = round(apart / period)
        drift = self._spec.clock_tolerance_ppm * 1e-6 * abs(apart) / max(len(heard) - 1, 1)
        off_grid = abs(apart - steps * period) - drift
        return steps if steps > 0 and off_grid < self._spec.on_grid_chips * chip_us else None

    def _fit(self, heard: tuple[_Heard, ...]) -> tuple[float, float]:
        """(time of the last preamble, chip length), us: least squares with the nominal rate as prior."""
        nominal = self._packet.chip_us
        chips = [(h.packet - heard[-1].packet) * self._packet.packet_chips for h in heard]
        late = [h.on_us - heard[-1].on_us - c * nominal for h, c in zip(heard, chips, strict=True)]
        prior = _TIMING_SIGMA_US / (self._spec.clock_tolerance_ppm * 1e-6 * nominal)
        mean_chips, mean_late = fmean(chips), fmean(late)
        # The prior stands at chip 0 without lateness, whatever the grid: it bears on the slope alone.
        power = sum((c - mean_chips) ** 2 for c in chips) + prior**2
        slope = sum((c - mean_chips) * t for c, t in zip(chips, late, strict=True)) / power
        return heard[-1].on_us + mean_late - slope * mean_chips, nominal + slope

    def _lock(self, heard: tuple[_Heard, ...]) -> SyncLock:
        grid_us, chip_us = self._fit(heard)
        onset = float(np.mean([h.onset_us - h.on_us for h in heard]))
        apart = float(np.mean([h.off_us - h.on_us for h in heard]))
        return SyncLock(
            packet_t_us=grid_us + onset,
            chip_us=chip_us,
            delay_on_us=-onset,
            delay_off_us=apart - onset,
            quality=heard[-1].quality,
        )


def _first_maximum(values: NDArray[np.float64], start: int, stop: int) -> int:
    start = max(start, 0)
    return start + int(np.argmax(values[start:stop]))
