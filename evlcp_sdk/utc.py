"""UTC of a camera's clock: of its start, or by a pulse on the trigger input at each second of UTC."""

from bisect import bisect_right
from datetime import UTC, datetime, timedelta

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.values import Triggers

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

_MAX_DEVIATION = 1e-3
"""Share by which a second of the camera's clock may differ from UTC's; beyond it, it is no such pulse."""

_MIN_AGREEING = 3
"""Consecutive pulses that agree with one another, but not with earlier ones, after which these are new."""

_MAX_PULSES = 1024
"""Pulses that are kept: a result asks at most some seconds after its light."""


class PulseClock:
    """UTC of a camera's clock by pulses (PPS), one each second of UTC, on its trigger input.

    Pulses are rising edges. The second of the first pulse is the one nearest to the UTC known beforehand,
    which must be right to less than half a second and holds until then. Between pulses the rate of the last
    two holds, so that a time's UTC depends on no later pulse.

    Args:
        channel: Of the trigger input.
        near: UTC of the camera clock's 0, to less than half a second; None for the computer's clock.

    Attributes:
        is_dated: UTC is known beforehand; the computer's clock is not asked.
        channel: Of the trigger input.
        counts: `pulses` that are accepted, and `pulses_rejected`.
        other_channels: Further channels of the trigger input with rising edges.

    Raises:
        ConfigError: The channel is not one of 0 to 255.

    >>> clock = PulseClock(near=datetime(2026, 3, 1, tzinfo=UTC))
    >>> clock.add(Triggers.of([250_000, 1_250_020], [0, 0], [1, 1]), now_s=0.0, now_us=0.0)
    >>> clock_zero_at(clock, 1_250_020).isoformat(), round(clock.rate_ppm, 3)
    ('2026-02-28T23:59:59.749980+00:00', 20.0)
    """

    def __init__(self, channel: int = 0, near: datetime | None = None) -> None:
        if not 0 <= channel <= 255:
            raise ConfigError(f"pulses on channel {channel}: expected 0 to 255")
        self.channel = channel
        self.other_channels: set[int] = set()
        self.is_dated = near is not None
        self._near_s = None if near is None else near.timestamp()
        self._approximate_s = self._near_s
        self._t_us: list[int] = []
        self._s: list[int] = []
        self._strays: list[int] = []
        self.counts = {"pulses": 0, "pulses_rejected": 0}

    def add(self, triggers: Triggers, now_s: float, now_us: float) -> None:
        """Add the next triggers, in order of time.

        `now_s` is UTC since 1970 by the computer's clock, s, and `now_us` the camera's clock at that time,
        us.
        """
        rising = triggers.value == 1
        pulses = rising & (triggers.channel == self.channel)
        self.other_channels |= set(triggers.channel[rising & ~pulses].tolist())
        near_s = now_s - now_us * 1e-6 if self._near_s is None else self._near_s
        if self._approximate_s is None:
            self._approximate_s = near_s
        for t_us in triggers.t_us[pulses].tolist():
            self._add_pulse(t_us, near_s)

    def _add_pulse(self, t_us: int, near_s: float) -> None:
        if not self._t_us:
            self._append_pulse(t_us, round(near_s + t_us * 1e-6))
            return
        after_s = _whole_seconds(t_us - self._t_us[-1])
        if after_s:
            self._strays.clear()
            self._append_pulse(t_us, self._s[-1] + after_s)
            return
        self.counts["pulses_rejected"] += 1
        if self._strays and not _whole_seconds(t_us - self._strays[-1]):
            self._strays.clear()
        self._strays.append(t_us)
        if len(self._strays) == _MIN_AGREEING:
            # The first one was no pulse, or the camera's clock has leaped.
            first_us, *others = self._strays
            self._strays.clear()
            first_s = near_s + first_us * 1e-6
            if first_us < self._t_us[-1]:
                # The clock has restarted: what was known beforehand is of its old 0.
                first_s = round(first_s) if self._near_s is None else self._s[-1] + 1
                self._approximate_s = first_s - first_us * 1e-6
                self._t_us.clear()
                self._s.clear()
            elif self._near_s is not None and len(self._t_us) > 1:
                first_s = self.utc_s(first_us) or first_s
            self.counts["pulses_rejected"] -= _MIN_AGREEING
            self._append_pulse(first_us, round(first_s))
            for other_us in others:
                self._append_pulse(other_us, self._s[-1] + _whole_seconds(other_us - self._t_us[-1]))

    def _append_pulse(self, t_us: int, s: int) -> None:
        self._t_us.append(t_us)
        self._s.append(s)
        self.counts["pulses"] += 1
        if len(self._t_us) == 2 * _MAX_PULSES:
            del self._t_us[:_MAX_PULSES], self._s[:_MAX_PULSES]

    def to_dict(self) -> dict[str, int | float | list[int] | None]:
        """Counts, rate, channel, and other channels with edges, as JSON values."""
        rate_ppm = None if self.rate_ppm is None else round(self.rate_ppm, 3)
        others = sorted(self.other_channels)
        return {**self.counts, "rate_ppm": rate_ppm, "channel": self.channel, "others": others}

    def utc_s(self, t_us: float) -> float | None:
        """UTC since 1970 of a time of the camera's clock, s; None before it is known."""
        last = bisect_right(self._t_us, t_us) - 1
        if last < 0:
            return None if self._approximate_s is None else self._approximate_s + t_us * 1e-6
        s_per_us = 1e-6
        if last and _whole_seconds(self._t_us[last] - self._t_us[last - 1]):
            s_per_us = (self._s[last] - self._s[last - 1]) / (self._t_us[last] - self._t_us[last - 1])
        return self._s[last] + (t_us - self._t_us[last]) * s_per_us

    @property
    def rate_ppm(self) -> float | None:
        """Rate of the camera's clock above UTC's by the last two pulses, ppm; None before these."""
        if len(self._t_us) < 2 or not _whole_seconds(self._t_us[-1] - self._t_us[-2]):
            return None
        return (self._t_us[-1] - self._t_us[-2]) / (self._s[-1] - self._s[-2]) - 1e6


ClockZero = datetime | PulseClock | None
"""The UTC of the camera clock's 0: a time, pulses that give it, or None where it is unknown."""


def clock_zero_at(zero: ClockZero, t_us: float) -> datetime | None:
    """UTC of the camera clock's 0 as it holds at a time of that clock; None where it is not known."""
    if not isinstance(zero, PulseClock):
        return zero
    utc_s = zero.utc_s(t_us)
    if utc_s is None:
        return None
    return _EPOCH + timedelta(seconds=int(utc_s // 1), microseconds=round(utc_s % 1 * 1e6 - t_us))


def to_utc_ns(zero: ClockZero, t_us: float) -> int:
    """A time of the camera's clock as UTC since 1970, ns; the clock itself where UTC is not known."""
    zero_utc = clock_zero_at(zero, t_us)
    zero_us = 0 if zero_utc is None else round(zero_utc.timestamp() * 1e6)
    return zero_us * 1000 + round(t_us * 1000)


def _whole_seconds(span_us: int) -> int:
    """Seconds from one pulse to the next; 0 where they are no whole number."""
    seconds = round(span_us * 1e-6)
    return seconds if seconds > 0 and abs(span_us - seconds * 1e6) <= _MAX_DEVIATION * seconds * 1e6 else 0
