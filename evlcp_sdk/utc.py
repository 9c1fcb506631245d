"""UTC of a camera's clock: known once, or by pulses that each second of UTC gives its trigger input."""

from bisect import bisect_right
from datetime import UTC, datetime, timedelta

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.values import Triggers

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

_MOST_OFF = 1e-3
"""How far a second of the camera's clock may be from one of UTC: what is farther off is no such pulse."""

_AGREE = 3
"""So many pulses on end that agree with one another, and not with those before, begin anew."""

_MOST_KEPT = 1024
"""Pulses that are kept: results are told of at most some seconds after their light."""


class PulseClock:
    """UTC of a camera's clock by pulses (PPS), one each second of UTC, on its trigger input.

    Rising edges count. Which second the first pulse begins is the nearest to what is known beforehand, which
    must be right to less than half a second, and holds before it. Between pulses the rate of the last two
    holds, so that what a time is called depends on no later pulse.

    Args:
        channel: Of the trigger input.
        near: UTC of the camera clock's 0, to less than half a second; None: as the computer's clock says.

    Attributes:
        dated: UTC is known beforehand; the computer's clock is not asked.
        channel: Of the trigger input.
        counts: `pulses` that are believed, and `pulses_rejected`.
        others: Channels of the trigger input on which something rose, beside its own.

    Raises:
        ConfigError: The channel is not one of 0 to 255.

    >>> clock = PulseClock(near=datetime(2026, 3, 1, tzinfo=UTC))
    >>> clock.add(Triggers.of([250_000, 1_250_020], [0, 0], [1, 1]), now_s=0.0, now_us=0.0)
    >>> zero_at(clock, 1_250_020).isoformat(), round(clock.rate_ppm, 3)
    ('2026-02-28T23:59:59.749980+00:00', 20.0)
    """

    def __init__(self, channel: int = 0, near: datetime | None = None) -> None:
        if not 0 <= channel <= 255:
            raise ConfigError(f"pulses on channel {channel}: expected 0 to 255")
        self.channel = channel
        self.others: set[int] = set()
        self.dated = near is not None
        self._near_s = None if near is None else near.timestamp()
        self._approximate_s = self._near_s
        self._t_us: list[int] = []
        self._s: list[int] = []
        self._strays: list[int] = []
        self.counts = {"pulses": 0, "pulses_rejected": 0}

    def add(self, triggers: Triggers, now_s: float, now_us: float) -> None:
        """Take the next triggers.

        Args:
            triggers: In order of time.
            now_s: UTC since 1970 as the computer's clock has it, s.
            now_us: The camera's clock at that time, us.
        """
        rising = triggers.value == 1
        mine = rising & (triggers.channel == self.channel)
        if mine.sum() < rising.sum():
            self.others |= set(triggers.channel[rising & ~mine].tolist())
        near_s = now_s - now_us * 1e-6 if self._near_s is None else self._near_s
        if self._approximate_s is None:
            self._approximate_s = near_s
        for t_us in triggers.t_us[mine].tolist():
            self._pulse(t_us, near_s)

    def _pulse(self, t_us: int, near_s: float) -> None:
        if not self._t_us:
            self._keep(t_us, round(near_s + t_us * 1e-6))
            return
        after_s = _seconds(t_us - self._t_us[-1])
        if after_s:
            self._strays.clear()
            self._keep(t_us, self._s[-1] + after_s)
            return
        self.counts["pulses_rejected"] += 1
        if self._strays and not _seconds(t_us - self._strays[-1]):
            self._strays.clear()
        self._strays.append(t_us)
        if len(self._strays) == _AGREE:
            # The first one was no pulse, or the camera's clock has leaped.
            first_us, *others = self._strays
            self._strays.clear()
            begins_s = near_s + first_us * 1e-6
            if self._near_s is not None and len(self._t_us) > 1:
                begins_s = self.utc_s(first_us) or begins_s
            if first_us < self._t_us[-1]:
                self._t_us.clear()
                self._s.clear()
            self.counts["pulses_rejected"] -= _AGREE
            self._keep(first_us, round(begins_s))
            for other_us in others:
                self._keep(other_us, self._s[-1] + _seconds(other_us - self._t_us[-1]))

    def _keep(self, t_us: int, s: int) -> None:
        self._t_us.append(t_us)
        self._s.append(s)
        self.counts["pulses"] += 1
        if len(self._t_us) == 2 * _MOST_KEPT:
            del self._t_us[:_MOST_KEPT], self._s[:_MOST_KEPT]

    def to_dict(self) -> dict[str, int | float | list[int] | None]:
        """The counts, the rate, the channel and the others on which something came, as JSON values."""
        rate_ppm = None if self.rate_ppm is None else round(self.rate_ppm, 3)
        return {**self.counts, "rate_ppm": rate_ppm, "channel": self.channel, "others": sorted(self.others)}

    def utc_s(self, t_us: float) -> float | None:
        """UTC since 1970 of a time of the camera's clock, s; None before anything is known."""
        last = bisect_right(self._t_us, t_us) - 1
        if last < 0:
            return None if self._approximate_s is None else self._approximate_s + t_us * 1e-6
        s_per_us = 1e-6
        if last:
            span_us = self._t_us[last] - self._t_us[last - 1]
            if _seconds(span_us):
                s_per_us = (self._s[last] - self._s[last - 1]) / span_us
        return self._s[last] + (t_us - self._t_us[last]) * s_per_us

    @property
    def rate_ppm(self) -> float | None:
        """How much faster the camera's clock is than UTC by the last two pulses, ppm; None before these."""
        if len(self._t_us) < 2 or not _seconds(self._t_us[-1] - self._t_us[-2]):
            return None
        return (self._t_us[-1] - self._t_us[-2]) / (self._s[-1] - self._s[-2]) - 1e6


ClockZero = datetime | PulseClock | None
"""What says the UTC of the camera clock's 0: a time, pulses, or nothing."""


def zero_at(zero: ClockZero, t_us: float) -> datetime | None:
    """UTC of the camera clock's 0 by which a time is UTC when it is added; None where it is not known."""
    if not isinstance(zero, PulseClock):
        return zero
    utc_s = zero.utc_s(t_us)
    if utc_s is None:
        return None
    return _EPOCH + timedelta(seconds=int(utc_s // 1), microseconds=round(utc_s % 1 * 1e6 - t_us))


def at_ns(zero: ClockZero, t_us: float) -> int:
    """A time of the camera's clock since 1970, UTC, ns; the clock itself where UTC is not known."""
    begin = zero_at(zero, t_us)
    begin_us = 0 if begin is None else round(begin.timestamp() * 1e6)
    return begin_us * 1000 + round(t_us * 1000)


def _seconds(span_us: int) -> int:
    """Whole seconds from one pulse to the next; 0 where it is no whole number of them."""
    seconds = round(span_us * 1e-6)
    return seconds if seconds > 0 and abs(span_us - seconds * 1e6) <= _MOST_OFF * seconds * 1e6 else 0
