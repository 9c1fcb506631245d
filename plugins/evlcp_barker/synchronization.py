"""Packet timing: finds preambles by sliding correlation, and filters their times and the clock."""

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_barker import _kernels
from evlcp_barker.bound import due_chips, guard_chips, least_correlation
from evlcp_sdk.air.codebook import Codebook, is_pair_code
from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.roles import Synchronization
from evlcp_sdk.values import SyncLock, to_kernel_array

Floats = NDArray[np.float64]

_OUTSTANDING_RMS = 6.0
"""A correlation so many times the rms of a packet's others is a preamble: random data reach 5 in 20 s. The
rms is no less than one over the root of the events' number, that of random signs."""

_TIMING_SIGMA_US = 2.0
"""Least error of one packet's time, from the grid of the correlation and the jitter of the pixels."""

_LATENCY_SIGMA_US = 0.5
"""Change of the pixels' latency from packet to packet: it is 3.3 us W/m2 over the light, 20 us at 0.17 W/m2,
and changes by as much where the light changes by 2.5 %, as when a bar comes nearer."""

_JUMP_SIGMAS = 3.0
"""Sigmas beyond which the latency has jumped (a wiper, a shadow), by as much as measured: a clock cannot."""

_WANDER_PPM = 0.1
"""Change of a quartz's rate in a second as it warms up."""

_CLEAR_DIFFERENCE = 0.1
"""Difference in correlation between a preamble and data: from packet to packet it varies by 0.02."""

_QUALITY_PACKETS = 8
"""Packets over which a lock's correlation is averaged."""

_CHIP_STEPS = 10
"""Correlation steps in a chip: a peak's flat top is a chip long, and its middle is found between steps."""

_MIN_EVENTS = 100
"""Least events of a detected preamble: of fewer, random signs may agree with its 26 chips."""

_ON_GRID_CHIPS = 0.6
"""How far from its expected time a preamble keeps the lock; latency grows by 0.5 behind a wiper."""


_MAX_STRAYS = 4
"""Newest peaks off a lock's grid that are kept: one cluster's data in between may look like a preamble."""


@dataclass(frozen=True)
class BarkerSync(Synchronization):
    """Preamble correlation at sub-chip steps, then a Kalman filter of clock and latency.

    In a preamble all clusters blink in phase; in pilots they cancel, and in info segments they differ. So the
    signed events of a whole region, summed over windows of one chip, correlate with the preamble's chips
    there and nowhere else. Positive and negative events come with different delays, which are measured apart
    at every packet, each with its sigma, by the jackknife over the preamble's values: a panel behind the bar
    adds events to some of them. The clock's rate is all but constant and within a bound; latency wanders with
    the light, and jumps where the light does. A measurement far from its prediction is a jump of the latency
    and does not change the rate.

    The correlation from which on it is a preamble follows from the codes: see `evlcp_barker.bound`.
    """

    min_correlation: Annotated[
        float,
        Field(
            ge=0,
            lt=1,
            description="Normalised correlation that makes a preamble; half as much where it stands out, 6"
            " times the rms of a packet's others. 0: by the codebook, 0.5 for the built-in one.",
        ),
    ] = 0.0
    clock_tolerance_ppm: Annotated[
        float, Field(gt=0, le=10_000, description="How far apart the two clocks may be: a bound.")
    ] = 100.0

    def compile(self, codebook: Codebook, packet: PacketFormat) -> "BarkerSynchronizer":
        """Precompute the correlation's weights."""
        return BarkerSynchronizer(self, codebook, packet)


@dataclass(frozen=True)
class _Level:
    """A value and its variance; NaN where it was not measured."""

    value: float
    variance: float

    def after(self, other: "_Level") -> "_Level":
        """How much more it is than another, measured apart."""
        return _Level(self.value - other.value, self.variance + other.variance)

    def update(self, measured: "_Level", drift_variance: float) -> "_Level":
        """Update by a measurement (Kalman), by the variance of the change since the last; it may jump."""
        if math.isnan(measured.value):
            return self
        change, spread = measured.value - self.value, self.variance + drift_variance + measured.variance
        # A change too large for a drift is a jump, whose variance is its square.
        spread = max(spread, change**2) if change**2 > _JUMP_SIGMAS**2 * spread else spread
        gain = 1 - measured.variance / spread
        return _Level(self.value + gain * change, gain * measured.variance)


class _Preamble(NamedTuple):
    """Time of a preamble's positive events, us; how much later its negative and first positive ones come."""

    on: _Level
    off_delay: _Level
    onset: _Level


@dataclass(frozen=True)
class _Clock:
    """A lock: the newest preamble as filtered.

    Attributes:
        packet: Its number since the first of this lock.
        preambles: Of how many it comes.
        on_us: Time of its positive events.
        rate_us: How much longer than nominal a packet is.
        variances: Of the time, of both together, of the rate.
        off_delay: How much later negative events come.
        onset: How much later the first positive events come.
        quality: Mean correlation of the newest.
    """

    packet: int
    preambles: int
    on_us: float
    rate_us: float
    variances: tuple[float, float, float]
    off_delay: _Level
    onset: _Level
    quality: float


class _Peak(NamedTuple):
    """A peak of the correlation at a lag of some event counts: a preamble within a chip of it."""

    first_bin: int
    counts: Floats
    lag: int
    quality: float


class SyncState(NamedTuple):
    """What synchronization remembers: recent event counts (OFF, ON) a step, its lock, and peaks off it.

    `power` and `known` are the mean square of the positive correlations lately, and their number.
    """

    first_bin: int | None = None
    counts: Floats = np.zeros((2, 0))
    next_bin: int = 0
    power: float = 0.0
    known: int = 0
    clock: _Clock | None = None
    strays: tuple[_Peak, ...] = ()


class BarkerSynchronizer:
    """`BarkerSync` for one codebook and packet format; pure but for what `step` is given."""

    def __init__(self, spec: BarkerSync, codebook: Codebook, packet: PacketFormat) -> None:
        self._packet = packet
        # Events come behind edges, and late ones agree with the chip that they come in.
        self._chips = 2 * codebook.preamble.astype(np.float64) - 1
        self._chips_per_part = 2 if is_pair_code(codebook.preamble) else 1
        self._due = due_chips(codebook.preamble)
        self._bin_us = packet.chip_us / _CHIP_STEPS
        self._packet_us = packet.packet_us
        self._max_drift_us = spec.clock_tolerance_ppm * 1e-6 * packet.packet_chips * packet.chip_us
        rising = np.flatnonzero(np.diff(self._chips) > 0) + 1
        if not len(rising):
            raise ConfigError("synchronization 'barker': a preamble without a rise finds no time")
        self._threshold = spec.min_correlation or least_correlation(
            codebook, packet.frames, packet.pilot_every
        )
        # A correlation peak stands alone within this distance.
        self._guard = _CHIP_STEPS * guard_chips(codebook.preamble, self._threshold)
        self._span = _CHIP_STEPS * len(self._chips)
        # Half of a packet's correlations are positive.
        self._max_known = _CHIP_STEPS * packet.packet_chips // 2
        # In a preamble from lag 0 on: of each chip, where it may begin; of each rise, the steps around it.
        self._signs = np.stack([-self._chips, self._chips])[:, :, None]
        self._begins = np.arange(2 * _CHIP_STEPS + 1) + _CHIP_STEPS * np.arange(len(self._chips))[:, None]
        self._rise_steps = _CHIP_STEPS * rising[:, None] + np.arange(-_CHIP_STEPS, _CHIP_STEPS)

    def init(self) -> SyncState:
        """State before the first event."""
        return SyncState()

    def step(
        self, state: SyncState, t_us: NDArray[np.int64], p: NDArray[np.uint8], until_us: int
    ) -> tuple[SyncState, list[SyncLock]]:
        """Count events, correlate what is complete, return a lock for each preamble (see `Synchronizer`)."""
        span, guard = self._span, self._guard
        before_bin, before, next_bin, power, known, clock, strays = state
        until_bin = int(until_us // self._bin_us)
        if before_bin is None:
            # A preamble starts with a dark chip: the first event may already be the edge at its end.
            before_bin = next_bin = (int(t_us[0] // self._bin_us) if t_us.size else until_bin) - guard
        # Bins that no later peak can be near are dropped.
        first_bin = max(next_bin - guard, before_bin)
        lo, bins = next_bin - first_bin, max(until_bin, before_bin + before.shape[1] - 1) - first_bin
        lags = bins - span + 1
        if not t_us.size and lags - guard > lo and not before[:, first_bin - before_bin :].any():
            # Silence has no correlation, and most regions that are no bar are silent.
            first = max(first_bin + lags - 2 * guard, first_bin)
            counts = np.zeros((2, first_bin + bins + 1 - first))
            return state._replace(first_bin=first, counts=counts, next_bin=first_bin + lags - guard), []
        # The last bin is still open: its events count, but it is not correlated yet.
        counts = np.empty((2, bins + 1))
        locks: list[SyncLock] = []
        where = first_bin, self._bin_us, first_bin - before_bin
        _kernels.count_bins(to_kernel_array(t_us), to_kernel_array(p), where, before, counts)
        if lags - guard > lo:
            rho, peaks = np.empty(lags), np.empty(lags - guard - lo, np.int64)
            _kernels.correlate(counts, self._chips, self._due, _CHIP_STEPS, _MIN_EVENTS, rho)
            past, enough = (power, known, self._max_known), (_OUTSTANDING_RMS, self._threshold)
            power, known, many = _kernels.find_peaks(rho, counts, span, lo, guard, past, enough, peaks)
            for lag in peaks[:many].tolist():
                peak, old = _Peak(first_bin, counts, lag, float(rho[lag])), clock
                clock, strays = self._accept_peak(clock, strays, peak)
                if clock is not old:
                    locks.append(self._build_lock(clock, peak.quality))
            lo = lags - guard
        return SyncState(first_bin, counts, first_bin + lo, power, known, clock, strays), locks

    def _refine_peak(self, peak: _Peak) -> _Preamble:
        first_bin, counts, lag, _ = peak
        (off, off_noise), (on, on_noise) = self._fit_polarities(counts, lag)
        response = counts[1].take(lag + self._rise_steps, mode="clip")
        onset, onset_noise = _jackknife(_find_onsets(_leave_one_out(response)))
        if math.isnan(on):
            on, on_noise = off, off_noise
        bin_us = self._bin_us

        def to_us(steps: float, noise: float) -> _Level:
            return _Level((first_bin + steps) * bin_us, _TIMING_SIGMA_US**2 + noise * bin_us**2)

        positive = to_us(on, on_noise)
        return _Preamble(
            on=positive,
            off_delay=to_us(off, off_noise).after(positive),
            onset=to_us(lag - _CHIP_STEPS + onset, onset_noise).after(positive),
        )

    def _fit_polarities(self, counts: Floats, lag: int) -> list[tuple[float, float]]:
        """Where near a lag negative events fit a preamble best, and positive ones; NaN where none do.

        In steps, each with its variance by the jackknife over chips, or over pairs of them in pair codes.
        """
        first, last = max(lag - _CHIP_STEPS, 0), min(lag + _CHIP_STEPS + 1, counts.shape[1] - self._span + 1)
        running = np.zeros((2, last - first + self._span))
        np.cumsum(counts[:, first : first + running.shape[1] - 1], axis=1, out=running[:, 1:])
        chips = running[:, _CHIP_STEPS:] - running[:, :-_CHIP_STEPS]
        parts = self._signs * chips[:, self._begins[:, : last - first]]
        if self._chips_per_part > 1:
            parts = parts.reshape(2, -1, self._chips_per_part, last - first).sum(2)
        found = map(_jackknife, _find_middles(_leave_one_out(parts)).tolist())
        return [(first + middle, noise) for middle, noise in found]

    def _accept_peak(
        self, clock: _Clock | None, strays: tuple[_Peak, ...], peak: _Peak
    ) -> tuple[_Clock, tuple[_Peak, ...]]:
        """Add a preamble to its lock; off it, a better one than its only one, or a second, begins a new lock.

        One symbol on all clusters at once blinks in phase, too, but can agree with 16 chips of 26 only. Most
        peaks of a lamp are on no grid: only those that may be are refined.
        """
        if clock is None:
            return self._start_clock(peak), ()
        followed = self._follow_clock(clock, peak)
        if followed is not None:
            return followed, ()
        if clock.preambles == 1 and peak.quality > clock.quality + _CLEAR_DIFFERENCE:
            return self._start_clock(peak), ()
        if peak.quality < clock.quality - _CLEAR_DIFFERENCE:
            return clock, strays
        for stray in strays:
            if self._can_follow(self._peak_us(stray), 0.0, peak, 2):
                followed = self._follow_clock(self._start_clock(stray), peak)
                if followed is not None:
                    return followed, ()
        return clock, (*strays, peak)[-_MAX_STRAYS:]

    def _peak_us(self, peak: _Peak) -> float:
        """Where a peak's preamble begins, to within a chip."""
        return (peak.first_bin + peak.lag) * self._bin_us

    def _can_follow(self, before_us: float, rate_us: float, peak: _Peak, chips: int) -> bool:
        """Whether a peak may be whole packets after a preamble; the two are known to so many chips."""
        packet_us = self._packet_us + rate_us
        apart_us = self._peak_us(peak) - before_us
        packets = round(apart_us / packet_us)
        off_us = abs(apart_us - packets * packet_us) - packets * self._max_drift_us
        return packets > 0 and off_us < (chips + _ON_GRID_CHIPS) * self._packet.chip_us

    def _start_clock(self, peak: _Peak) -> _Clock:
        found = self._refine_peak(peak)
        return _Clock(
            packet=0,
            preambles=1,
            on_us=found.on.value,
            rate_us=0.0,
            # The bound is two sigmas.
            variances=(found.on.variance, 0.0, (self._max_drift_us / 2) ** 2),
            off_delay=_Level(0.0, self._packet.chip_us**2)
            if math.isnan(found.off_delay.value)
            else found.off_delay,
            onset=found.onset,
            quality=peak.quality,
        )

    def _predict(self, clock: _Clock, packets: int) -> tuple[float, float, float, float]:
        """Time of the preamble so many packets after the lock's, and the variances there (see `_Clock`)."""
        time, both, rate = clock.variances
        nominal_us = self._packet_us
        rate += (_WANDER_PPM * 1e-6 * nominal_us) ** 2 * packets * nominal_us * 1e-6
        time += 2 * packets * both + packets**2 * rate + packets * _LATENCY_SIGMA_US**2
        return clock.on_us + packets * (nominal_us + clock.rate_us), time, both + packets * rate, rate

    def _follow_clock(self, clock: _Clock, peak: _Peak) -> _Clock | None:
        """The lock with a peak's preamble more; None if that is off its grid."""
        if not self._can_follow(clock.on_us, clock.rate_us, peak, 1):
            return None
        found = self._refine_peak(peak)
        packets = round((found.on.value - clock.on_us) / (self._packet_us + clock.rate_us))
        if packets <= 0:
            return None
        expected, time, both, rate = self._predict(clock, packets)
        late, noise, most_us = found.on.value - expected, found.on.variance, self._max_drift_us
        if abs(late) - min(2 * math.sqrt(time), packets * most_us) >= _ON_GRID_CHIPS * self._packet.chip_us:
            return None
        if late**2 > _JUMP_SIGMAS**2 * (time + noise):
            # The latency's jump adds to the time's variance alone, so that hardly any of it goes to the rate.
            time = late**2 - noise
        spread = time + noise
        rate_us = min(max(clock.rate_us + both / spread * late, -most_us), most_us)
        walk = packets * _LATENCY_SIGMA_US**2
        preambles = min(clock.preambles + 1, _QUALITY_PACKETS)
        return _Clock(
            packet=clock.packet + packets,
            preambles=preambles,
            on_us=expected + time / spread * late,
            rate_us=rate_us,
            variances=(time * noise / spread, both * noise / spread, rate - both**2 / spread),
            off_delay=clock.off_delay.update(found.off_delay, walk),
            onset=clock.onset.update(found.onset, walk),
            quality=clock.quality + (peak.quality - clock.quality) / preambles,
        )

    def _build_lock(self, clock: _Clock, quality: float) -> SyncLock:
        onset = clock.onset.value
        return SyncLock(
            packet_t_us=clock.on_us + onset,
            chip_us=self._packet.chip_us + clock.rate_us / self._packet.packet_chips,
            delay_on_us=-onset,
            delay_off_us=clock.off_delay.value - onset,
            quality=quality,
        )


def _leave_one_out(parts: Floats) -> Floats:
    """The sum of parts (..., n, m), then the sums without each of them, (..., 1 + n, m)."""
    whole = parts.sum(-2, keepdims=True)
    return np.concatenate([whole, whole - parts], -2)


def _find_middles(fits: Floats) -> Floats:
    """Where correlations (..., lags) are best; NaN where one is positive nowhere.

    The top is flat where a window holds all events of an edge: its middle is the best window.
    """
    top = fits.max(-1, keepdims=True)
    weight = np.maximum(fits - 0.9 * top, 0)
    total = np.where(top[..., 0] > 0, weight.sum(-1), np.nan)
    found: Floats = weight @ np.arange(fits.shape[-1]) / total
    return found


def _find_onsets(responses: Floats) -> list[float]:
    """Where counts (n, steps) first reach half of their maximum, over the background: a quartile."""
    found = []
    for response in responses.tolist():
        ordered = sorted(response)
        half, at = (ordered[len(ordered) // 4] + ordered[-1]) / 2, 0
        while response[at] < half:
            at += 1
        below = response[at - 1] if at else 0.0
        rise = response[at] - below
        found.append(at - 0.5 + ((half - below) / rise if rise > 0 else 0.0))
    return found


def _jackknife(estimates: list[float]) -> tuple[float, float]:
    """The estimate of all, and its variance by those without each; NaN among these is ignored."""
    of_all, *without = estimates
    many, total, squares = 0, 0.0, 0.0
    for value in without:
        if value == value:
            many, total = many + 1, total + value
    for value in without:
        if value == value:
            squares += (value - total / many) ** 2
    return of_all, (many - 1) * squares / many if many else 0.0
