"""Recognize the columns of any list of events: names, units of time, words for polarities."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.plugin.writer import LAST_TIME_US

UNITS_US: Final = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}

_UNIT: Final = re.compile(
    r"(?:in )?(?:(?P<s>s|secs?|seconds?)|(?P<ms>ms|msecs?|millis|milliseconds?)"
    # A micro sign of older programs is no UTF-8.
    r"|(?P<us>[uµμ\ufffd]s|usecs?|micros|microseconds?)|(?P<ns>ns|nsecs?|nanos|nanoseconds?))"
)
_TIME: Final = re.compile(
    r"(?P<name>(?:(?:events?|elapsed)[ _.]?)?(?:time[ _]?stamps?|times?|ts|t)(?:[ _.]events?)?)"
    r"(?:[ _.]*[(\[](?P<inside>[^()\[\]]*)[)\]]"
    r"|(?:[ _.]in)?(?:[ _.]+|[ _.]*/ ?)(?P<behind>[^ _./]+)|(?P<short>ms|us|ns))?"
)
_BRACKETS: Final = re.compile(r"[ _.]*[(\[][^()\[\]]*[)\]]$")
_NAMES: Final = {
    "p": re.compile(
        r"(?:events?[ _.]?|is[ _.]?)?(?:p|ps|pol|pols|polarity|polarities|on|on[ _/]?off|signs?|value|level"
        r"|type|state|change|brightness[ _.]change)(?:[ _.]events?)?"
    ),
    "x": re.compile(r"(?:events?[ _.]?)?(?:x|xs|x[ _]?px|col|column)"),
    "y": re.compile(r"(?:events?[ _.]?)?(?:y|ys|y[ _]?px|row|line)"),
}
_EVENT: Final = ("event", "events")
"""Names of the polarities where no other column has them: signs of events next to their times."""

_PAIRS: Final = (
    *(("1", "0"), ("+1", "-1"), ("true", "false"), ("t", "f"), ("on", "off"), ("cd_on", "cd_off")),
    *(("pos", "neg"), ("p", "n"), ("+", "-"), ("positive", "negative"), ("up", "down"), ("rise", "fall")),
    *(("rising", "falling"), ("high", "low"), ("increase", "decrease"), ("brighter", "darker")),
)
_ON: Final = frozenset(on for on, _ in _PAIRS)
_OFF: Final = frozenset(off for _, off in _PAIRS)

MIN_RATE_HZ: Final = 20.0
MAX_RATE_HZ: Final = 5e7
"""Events a second of pixels that see a blinking light; with fewer or more it is another unit."""

MAX_SENSOR_RATE_HZ: Final = 5e8
"""Most events a second of a whole sensor: half of what the fastest can read out."""

_BLINK_RATES_HZ: Final = (100.0, 6e4)
"""Chips or bits a second at which lights blink, edges of each bit included."""

_MIN_LINE_RATIO: Final = 30.0
"""Least ratio of a spectral line of a blinking light to the median around it; noise reaches 17 at one of 10^5
frequencies."""

_MIN_UNIT_RATIO: Final = 2.0
"""Least ratio of that line to the one by the next unit."""

_MAX_BINS: Final = 1 << 18

_LEVELS: Final = ((0, 1), (-1, 1), (1, 2), (255, 1), (0, 255))
"""Numbers for OFF and ON."""

_MIN_SPAN_S: Final = 0.1
_MIN_INTEGER_SPAN_S: Final = 0.01
_PLAUSIBLE_RATES_HZ: Final = (200.0, 2e6)
"""Least length of a list, least length of one of whole numbers, and plausible rates of pixels that see a
light. Where a list would be shorter or have a higher rate, its times were rounded to a unit a thousand times
as long."""

_EPOCH_S: Final = (0.9e9, 4.2e9)
"""Seconds since 1970 by the clocks of today's computers: from 1998 to 2103."""


class RowError(ValueError):
    """A value that its column cannot have.

    Args:
        row: Index of the value, from 0.
        what: The value and what was expected.
    """

    def __init__(self, row: int, what: str) -> None:
        super().__init__(what)
        self.row = row


@dataclass(frozen=True)
class TimeUnit:
    """The unit of the times of a list.

    Attributes:
        name: `s`, `ms`, `us` or `ns`.
        why: How it is known, for `evlcp info`.
        others: Other units that are possible, if it is guessed.
        sure: Whether it is stated, and nothing contradicts it.
    """

    name: str
    why: str
    others: tuple[str, ...] = ()
    sure: bool = False

    @property
    def guess(self) -> str:
        """The guess in words; empty if the unit is known."""
        if self.sure:
            return ""
        others = [unit for unit in self.others if unit != self.name]
        return f"times in {self.name}, {self.why}" + (f"; {' or '.join(others)} would do" if others else "")

    @property
    def length_us(self) -> float:
        """Its length, us."""
        return UNITS_US[self.name]

    def to_us(self, times: NDArray[Any]) -> NDArray[np.int64]:
        """Return times in us, rounded down, int64 (n,).

        Raises:
            RowError: One is not a number, or too large.
        """
        if times.dtype.kind == "f":
            # To a thousandth first: 0.000057 s times 1e6 is a little less than 57.
            scaled = np.round(times.astype(np.float64) * self.length_us, 3)
            self._refuse_where(~(np.abs(scaled) <= LAST_TIME_US), times)  # NaN too
            if len(times) and np.spacing(np.abs(times).max()) * self.length_us > 1e-3:
                # With fewer digits than thousandths of a microsecond need, to the nearest one.
                return np.rint(scaled).astype(np.int64)
            return np.floor(scaled).astype(np.int64)
        if self.name == "ns":
            return times.astype(np.int64) // 1000
        factor = round(self.length_us)
        most = LAST_TIME_US // factor
        self._refuse_where((times > most) | (times < -most), times)
        return times.astype(np.int64) * factor

    def _refuse_where(self, wrong: NDArray[np.bool_], times: NDArray[Any]) -> None:
        if wrong.any():
            row = int(wrong.argmax())
            raise RowError(
                row, f"time {times[row]} {self.name}, expected a number up to {LAST_TIME_US:.0e} us"
            )


@dataclass(frozen=True)
class Fields:
    """Numbers of the columns of a table that are time, polarity, x and y.

    Attributes:
        time: Number of the column of times.
        polarity: Number of the column of polarities.
        places: Numbers of the columns x and y; None without them.
        unit: The unit in the name of the times; None without one.
    """

    time: int
    polarity: int
    places: tuple[int, int] | None = None
    unit: str | None = None

    @property
    def numbers(self) -> tuple[int, ...]:
        """Numbers of the columns time, polarity, and perhaps x and y."""
        return (self.time, self.polarity, *(self.places or ()))


def fields_from_names(names: Sequence[str]) -> Fields | None:
    """Recognize the columns of a list of events by their names; None without a time and a polarity.

    Other columns are left out, and x and y if one of them is missing.

    >>> fields_from_names(["p", "t_ms"])
    Fields(time=1, polarity=0, places=None, unit='ms')
    >>> fields_from_names(["Timestamp [us]", "x", "y", "ON/OFF"])
    Fields(time=0, polarity=3, places=(1, 2), unit='us')
    >>> fields_from_names(["a", "b"]) is None
    True
    """
    names = [strip_cell(name).lower() for name in names]
    bare = [_BRACKETS.sub("", name) for name in names]
    units = {k: unit for k, name in enumerate(names) if (unit := _unit_from_time_name(name)) is not None}
    found = {key: [k for k, name in enumerate(bare) if word.fullmatch(name)] for key, word in _NAMES.items()}
    # `t` and `p` win over longer names that may mean something else.
    times = [k for k in units if len(units) == 1 or bare[k] in ("t", "ts", "time", "timestamp")]
    signs = found["p"] or [k for k, name in enumerate(bare) if name in _EVENT]
    signs = [k for k in signs if len(signs) == 1 or bare[k] in ("p", "pol", "polarity")]
    if len(times) != 1 or len(signs) != 1:
        return None
    places = (found["x"][0], found["y"][0]) if len(found["x"]) == len(found["y"]) == 1 else None
    return Fields(times[0], signs[0], places, units[times[0]] or None)


def unit_from_name(name: str) -> str | None:
    """Return the unit that a word names, perhaps in brackets; None if it names none.

    >>> unit_from_name("[microseconds]"), unit_from_name("p")
    ('us', None)
    """
    match = _UNIT.fullmatch(strip_cell(name).lower().strip("()[]").strip())
    return match.lastgroup if match else None


def strip_cell(cell: str) -> str:
    """Remove blanks and quotes around a cell."""
    return cell.strip(" \t\r\n\"'")


def _unit_from_time_name(name: str) -> str | None:
    """Return the unit in a name of times, empty without one; None if the name is not of times."""
    match = _TIME.fullmatch(name)
    if match is None:
        # A unit is a name of times, but `s` may be a sign.
        return unit_from_name(name) if len(name) > 1 else None
    unit = unit_from_name(match["inside"] or match["behind"] or match["short"] or "")
    return None if match["behind"] and unit is None else unit or ""


def parse_unit(text: str) -> str:
    """Parse the option of a unit of times."""
    if text not in UNITS_US:
        raise ValueError(", ".join(UNITS_US))
    return text


def fields_from_values(columns: Sequence[NDArray[Any]]) -> Fields | None:
    """Recognize the columns of a table by their values: two, or four with x and y, or one more.

    One more may number the rows, or be constant. Polarities are two values at most, times rise or have
    decimals.

    Args:
        columns: Some rows of each, numbers or words, (n,).

    Returns:
        The fields, or None if they cannot be told apart.

    >>> fields_from_values([np.array([1, 0, 1]), np.array([7, 9, 12])])
    Fields(time=1, polarity=0, places=None, unit=None)
    >>> fields_from_values([np.array(c) for c in ([0, 1], [1, 1], [1, 0], [70_000, 90_000])]).numbers
    (3, 2, 0, 1)
    """
    numeric = [column.dtype.kind in "iuf" for column in columns]
    kept = list(range(len(columns)))
    if len(columns) in (3, 5):
        kept = [k for k in kept if not (numeric[k] and _are_row_numbers(columns[k]))]
        if len(kept) == len(columns):
            kept = [k for k in kept if (columns[k] != columns[k][0]).any()]
    signs = [k for k in kept if _are_signs(columns[k]) and all(numeric[j] for j in kept if j != k)]
    if len(kept) not in (2, 4) or not signs:
        return None
    # If x and y are 0 and 1 too, polarities are the last column.
    times = others = [k for k in kept if k != signs[-1]]
    if len(others) > 1:
        # If all are small whole numbers, times are those that rise.
        rising = [k for k in others if (np.diff(columns[k].astype(np.float64)) >= 0).all()]
        times = [k for k in others if not _are_places(columns[k])] or rising
    if len(times) != 1:
        return None
    places = [k for k in others if k != times[0]]
    return Fields(times[0], signs[-1], (places[0], places[1]) if places else None)


def _are_row_numbers(column: NDArray[Any]) -> bool:
    return len(column) > 1 and bool((np.diff(column.astype(np.float64)) == 1).all())


def _are_places(column: NDArray[Any]) -> bool:
    return bool((column == np.floor(column)).all() and column.min() >= 0 and column.max() < 1 << 16)


def _are_signs(values: NDArray[Any]) -> bool:
    if values.dtype.kind == "b":
        return True
    if values.dtype.kind in "US":
        return all(is_polarity(_to_text(word)) for word in np.unique(values).tolist())
    return any(np.isin(values, pair).all() for pair in _LEVELS)


def infer_time_unit(
    times: NDArray[Any], named: str | None, share: float = 1.0, *, has_pixels: bool = False
) -> TimeUnit:
    """Return the unit of times: the stated one, or else the one in which a light blinks, or that of cameras.

    Lights blink at 100 to 60 000 chips a second, a range of less than a thousandfold, so that only one of
    units a thousandfold apart fits. If none does, times since 1970 show their unit; and a camera counts whole
    microseconds: its nanoseconds are multiples of 1000, its milliseconds have three decimals, its seconds
    six.
    A unit by which fewer than 20 or more than 50 million events come a second (500 million of a whole sensor)
    is another one. Times were rounded if a list of one light would be over in an instant, or its events come
    by the million, and would not in a unit a thousand times as long.

    Args:
        times: The first times, in any order, int64 or float64 (n,).
        named: The stated unit; None without one. `why` reports a light that blinks in another one.
        share: How much of all times these are.
        has_pixels: Whether the events are of many pixels.

    >>> infer_time_unit(np.array([0.000125, 0.000893, 0.00131]), None).name
    's'
    >>> infer_time_unit(np.array([125, 893, 1310]), None).name
    'us'
    >>> infer_time_unit(np.array([1_600_000_000_125_000, 1_600_000_000_893_100]), None).name
    'us'
    >>> infer_time_unit(np.array([0.125, 0.126, 0.131] * 100), None).name
    's'
    """
    inside = np.sort(times[np.isfinite(times)])
    span = float(np.ptp(inside)) if len(inside) else 0.0
    most_hz = MAX_SENSOR_RATE_HZ if has_pixels else MAX_RATE_HZ
    rates_hz = {
        unit: (len(inside) - 1) / (span * length_us * 1e-6) if span > 0 else MIN_RATE_HZ
        for unit, length_us in UNITS_US.items()
    }
    likely = tuple(unit for unit, rate in rates_hz.items() if span > 0 and MIN_RATE_HZ <= rate <= most_hz)
    blinks = _infer_from_blinking(inside)
    if named is not None:
        unit, rate_hz = blinks or (named, 0.0)
        why = f", but in {unit} a light would blink, a line at {rate_hz:.4g} Hz"
        sure = unit == named
        return TimeUnit(named, "as its column says" + ("" if sure else why), sure=sure)
    if blinks is not None:
        unit, rate_hz = blinks
        return TimeUnit(unit, f"guessed: a light blinks, a line at {rate_hz:.4g} Hz", likely)
    for unit, length_us in UNITS_US.items():
        # Microseconds after the first twenty minutes are no seconds of today, which lie close together.
        is_close = unit != "s" or span < 1e6
        ends_s = inside[[0, -1]] * (length_us * 1e-6) if len(inside) and is_close else np.zeros(1)
        if _EPOCH_S[0] < ends_s[0] and ends_s[-1] < _EPOCH_S[1]:
            return TimeUnit(unit, "guessed: times since 1970")
    return _infer_from_digits(inside, rates_hz, likely, share, has_pixels)


def _infer_from_digits(
    inside: NDArray[Any], rates_hz: dict[str, float], likely: tuple[str, ...], share: float, has_pixels: bool
) -> TimeUnit:
    """Return the unit whose digits the times show, or the next one if events come too close or too far."""
    most_hz = MAX_SENSOR_RATE_HZ if has_pixels else MAX_RATE_HZ
    are_whole, since = bool((inside == np.round(inside)).all()), inside - inside[:1]
    if are_whole and since.any() and (since % 1000 == 0).all() and rates_hz["ns"] <= most_hz:
        shown, digits = "ns", "whole numbers, multiples of 1000"
    elif are_whole:
        shown, digits = "us", "whole numbers"
    elif np.abs(inside * 1e3 - np.round(inside * 1e3)).max() < 1e-4:
        shown, digits = "ms", "3 decimals"
    else:
        shown, digits = "s", "6 decimals or more"
    units = list(UNITS_US)
    at = units.index(shown)
    if at:
        longer, (least_hz, sure_hz) = units[at - 1], _PLAUSIBLE_RATES_HZ
        if has_pixels:
            too_close = rates_hz[shown] > most_hz and longer in likely
        else:
            least_s = share * (_MIN_INTEGER_SPAN_S if shown == "us" else _MIN_SPAN_S)
            too_close = rates_hz[shown] > sure_hz or (len(inside) - 1) / rates_hz[shown] < least_s
            too_close &= least_hz <= rates_hz[longer] <= sure_hz
        if too_close:
            return TimeUnit(longer, f"guessed: {digits}, too close for {shown}", likely)
    # Nanoseconds have no decimals.
    shorter, last = (units[at:], shown) if are_whole else (units[at:-1], "us")
    unit = next((unit for unit in shorter if rates_hz[unit] >= MIN_RATE_HZ), last)
    why = f", too far apart for {shown}" if unit != shown else ""
    why += f", {rates_hz[unit]:.3g} events/s" if unit in likely else ""
    return TimeUnit(unit, f"guessed: {digits}{why}", likely)


def _infer_from_blinking(inside: NDArray[Any]) -> tuple[str, float] | None:
    """Return the only unit in which a light blinks, and its spectral line, Hz; None without one."""
    lines = (_find_spectral_line(inside * factor, unit) for unit, factor in UNITS_US.items())
    found = sorted((line for line in lines if line is not None), reverse=True)
    if not found or found[0][0] < _MIN_LINE_RATIO:
        return None
    if len(found) > 1 and found[0][0] < _MIN_UNIT_RATIO * found[1][0]:
        return None
    return found[0][1], found[0][2]


def _find_spectral_line(t_us: NDArray[Any], unit: str) -> tuple[float, str, float] | None:
    """Return the strongest line in the spectrum of the event rate: its ratio, the unit, its frequency, Hz.

    The ratio is to the power around it. Periods are at least sixteen steps of the times, and at most an
    eighth of their span.
    """
    steps = np.diff(np.unique(t_us))
    if not len(steps):
        return None
    since_us = t_us - t_us[0]
    high_hz = min(_BLINK_RATES_HZ[1], 1e6 / (16 * float(steps.min())))
    low_hz = max(_BLINK_RATES_HZ[0], 8e6 / float(since_us[-1]))
    if not 1.5 * low_hz <= high_hz or not math.isfinite(float(since_us[-1]) / float(steps.min())):
        return None
    # Bins of whole steps, so that they do not beat with them.
    bin_us = float(steps.min()) * max(int(1e6 / (4 * high_hz) / float(steps.min())), 1)
    bins = min(int(since_us[-1] / bin_us), _MAX_BINS) + 1
    counted = np.bincount(np.minimum(since_us / bin_us, bins).astype(np.int64), minlength=bins + 1)[:bins]
    power = np.abs(np.fft.rfft((counted - counted.mean()) * np.hanning(bins))) ** 2
    frequency_hz = np.fft.rfftfreq(bins, bin_us * 1e-6)
    around = np.maximum(_running_median(power), 1e-9 * power.max() + 1e-30)
    over = np.where((frequency_hz >= low_hz) & (frequency_hz <= high_hz), power / around, 0.0)
    best = int(over.argmax())
    return float(over[best]), unit, float(frequency_hz[best])


def _running_median(power: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the median of the hundred values on either side, interpolated between each hundredth."""
    middles = np.arange(0, len(power), 100)
    medians = [np.median(power[max(k - 100, 0) : k + 101]) for k in middles]
    return np.interp(np.arange(len(power)), middles, medians)


class Polarities:
    """Decodes a column of numbers or words to ON or OFF, by all values so far.

    Numbers are 0 and 1, -1 and 1, 1 and 2, 0 and 255, or 1 and 255, which is -1 in eight bits.
    """

    def __init__(self) -> None:
        self._levels: frozenset[float] = frozenset()

    def decode(self, values: NDArray[Any]) -> NDArray[np.uint8]:
        """Return polarities, uint8 (n,).

        Raises:
            RowError: A value is none, or does not go with those before.

        >>> Polarities().decode(np.array(["ON", "off"])).tolist()
        [1, 0]
        >>> Polarities().decode(np.array([2, 1, 1])).tolist()
        [1, 0, 0]
        """
        if values.dtype.kind in "US":
            return self._decode_words(values)
        found, first = np.unique(values, return_index=True)
        pair = _LEVELS[0]
        for level, row in sorted(zip(found.tolist(), first.tolist(), strict=True), key=lambda one: one[1]):
            known = self._levels | {level}
            match = next((pair for pair in _LEVELS if known <= set(pair)), None)
            if match is None:
                others = " and ".join(f"{other:g}" for other in sorted(self._levels))
                others = f" beside {others}" if others else ""
                raise RowError(
                    row, f"polarity {level:g}{others}, expected 0 and 1, or -1 and 1, 1 and 2, 0 and 255"
                )
            self._levels, pair = known, match
        return np.asarray(values == pair[1], np.uint8)

    @staticmethod
    def _decode_words(values: NDArray[Any]) -> NDArray[np.uint8]:
        words, indices = np.unique(values, return_inverse=True)
        texts = [_to_text(word) for word in words.tolist()]
        for k, text in enumerate(texts):
            if not is_polarity(text):
                row = int((indices.ravel() == k).argmax())
                raise RowError(row, f"polarity {text!r}, expected 0 or 1, or -1 or 1, or ON or OFF")
        return np.array([_normalize_word(text) in _ON for text in texts], np.uint8)[indices.ravel()]


def _to_text(value: str | bytes) -> str:
    return strip_cell(value.decode("utf-8", "replace") if isinstance(value, bytes) else value)


def _normalize_word(text: str) -> str:
    return text.lower().removesuffix(".0")


def is_polarity(text: str) -> bool:
    """Whether a word means ON or OFF."""
    return _normalize_word(text) in _ON | _OFF
