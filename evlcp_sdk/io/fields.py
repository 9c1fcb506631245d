"""What the columns of somebody's list of events mean: names, units of time, words for polarities."""

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
"""Polarities by this name, where no other column is: signs of events beside their times."""

_PAIRS: Final = (
    *(("1", "0"), ("+1", "-1"), ("true", "false"), ("t", "f"), ("on", "off"), ("cd_on", "cd_off")),
    *(("pos", "neg"), ("p", "n"), ("+", "-"), ("positive", "negative"), ("up", "down"), ("rise", "fall")),
    *(("rising", "falling"), ("high", "low"), ("increase", "decrease"), ("brighter", "darker")),
)
_ON: Final = frozenset(on for on, _ in _PAIRS)
_OFF: Final = frozenset(off for _, off in _PAIRS)

LEAST_RATE_HZ: Final = 20.0
MOST_RATE_HZ: Final = 5e7
"""Events a second of pixels that see a blinking light: with fewer, or more, the unit is another."""

MOST_PLACED_HZ: Final = 5e8
"""The same of a whole sensor: half of what the fastest can read out."""

_BLINKS_HZ: Final = (100.0, 6e4)
"""Chips or bits a second that lights blink at, edges of each bit included."""

_LINE: Final = 30.0
"""Of a spectrum's line over the median around it, by which a light surely blinks: one of 10^5 places of noise
reaches 17."""

_CLEARLY: Final = 2.0
"""How much stronger it is than by the next unit."""

_MOST_BINS: Final = 1 << 18

_LEVELS: Final = ((0, 1), (-1, 1), (1, 2), (255, 1), (0, 255))
"""OFF and ON."""

_LEAST_SPAN_S: Final = 0.1
_LEAST_COUNTED_S: Final = 0.01
_SURE_RATE_HZ: Final = (200.0, 2e6)
"""How long a list is at least, how long one of whole numbers, and what surely comes of pixels that see a
light: where a list would be shorter, or have more, its times were rounded to a thousand times as coarse."""

_EPOCH_S: Final = (0.9e9, 4.2e9)
"""Seconds since 1970 of a clock of today's computers: from 1998 to 2103."""


class RowError(ValueError):
    """A value that its column cannot have.

    Args:
        row: Its place among those given, from 0.
        what: Value and what was expected.
    """

    def __init__(self, row: int, what: str) -> None:
        super().__init__(what)
        self.row = row


@dataclass(frozen=True)
class TimeUnit:
    """What the times of a list count.

    Attributes:
        name: `s`, `ms`, `us` or `ns`.
        why: How that is known, for `evlcp info`.
        others: Units that would do, too, where it is guessed.
        sure: Somebody says it, and nothing speaks against it.
    """

    name: str
    why: str
    others: tuple[str, ...] = ()
    sure: bool = False

    @property
    def guess(self) -> str:
        """What was guessed, or is doubtful, in words; empty where the unit is known."""
        if self.sure:
            return ""
        others = [unit for unit in self.others if unit != self.name]
        return f"times in {self.name}, {self.why}" + (f"; {' or '.join(others)} would do" if others else "")

    @property
    def factor(self) -> float:
        """Its length, us."""
        return UNITS_US[self.name]

    def us(self, times: NDArray[Any]) -> NDArray[np.int64]:
        """Times in us, int64 (n,), rounded down.

        Raises:
            RowError: One is no number, or too large.
        """
        if times.dtype.kind == "f":
            # To a thousandth before that: 0.000057 s times 1e6 is a little less than 57.
            scaled = np.round(times.astype(np.float64) * UNITS_US[self.name], 3)
            # No number is not within, either.
            self._refuse(~(np.abs(scaled) <= LAST_TIME_US), times)
            if len(times) and np.spacing(np.abs(times).max()) * UNITS_US[self.name] > 1e-3:
                # Fewer digits than thousandths of a microsecond need: the nearest one.
                return np.rint(scaled).astype(np.int64)
            return np.floor(scaled).astype(np.int64)
        if self.name == "ns":
            return times.astype(np.int64) // 1000
        factor = round(UNITS_US[self.name])
        most = LAST_TIME_US // factor
        self._refuse((times > most) | (times < -most), times)
        return times.astype(np.int64) * factor

    def _refuse(self, wrong: NDArray[np.bool_], times: NDArray[Any]) -> None:
        if wrong.any():
            row = int(wrong.argmax())
            raise RowError(
                row, f"time {times[row]} {self.name}, expected a number up to {LAST_TIME_US:.0e} us"
            )


@dataclass(frozen=True)
class Fields:
    """Which columns of a table are time, polarity and place.

    Attributes:
        time: Number of the column of times.
        polarity: Number of the column of polarities.
        places: Numbers of the columns x and y; None where there are none.
        unit: The unit that the name of the first one says; None where it says none.
    """

    time: int
    polarity: int
    places: tuple[int, int] | None = None
    unit: str | None = None

    @property
    def which(self) -> tuple[int, ...]:
        """Numbers of the columns: time, polarity, and x and y where there are places."""
        return (self.time, self.polarity, *(self.places or ()))

    def of(self, numbers: Sequence[int]) -> "Fields":
        """The same where the columns have these numbers."""
        places = (numbers[self.places[0]], numbers[self.places[1]]) if self.places else None
        return Fields(numbers[self.time], numbers[self.polarity], places, self.unit)


def fields_of(names: Sequence[str]) -> Fields | None:
    """The columns of a list of events by their names; None where they do not say time and polarity.

    Others are left out; of places both or none.

    >>> fields_of(["p", "t_ms"])
    Fields(time=1, polarity=0, places=None, unit='ms')
    >>> fields_of(["Timestamp [us]", "x", "y", "ON/OFF"])
    Fields(time=0, polarity=3, places=(1, 2), unit='us')
    >>> fields_of(["a", "b"]) is None
    True
    """
    names = [plain(name).lower() for name in names]
    bare = [_BRACKETS.sub("", name) for name in names]
    units = {k: unit for k, name in enumerate(names) if (unit := _as_time(name)) is not None}
    found = {key: [k for k, name in enumerate(bare) if word.fullmatch(name)] for key, word in _NAMES.items()}
    # `t` and `p` before longer names that may mean something else.
    times = [k for k in units if len(units) == 1 or bare[k] in ("t", "ts", "time", "timestamp")]
    signs = found["p"] or [k for k, name in enumerate(bare) if name in _EVENT]
    signs = [k for k in signs if len(signs) == 1 or bare[k] in ("p", "pol", "polarity")]
    if len(times) != 1 or len(signs) != 1:
        return None
    places = (found["x"][0], found["y"][0]) if len(found["x"]) == len(found["y"]) == 1 else None
    return Fields(times[0], signs[0], places, units[times[0]] or None)


def unit_of(name: str) -> str | None:
    """The unit that a word says, perhaps in brackets; None where it says none.

    >>> unit_of("[microseconds]"), unit_of("p")
    ('us', None)
    """
    match = _UNIT.fullmatch(plain(name).lower().strip("()[]").strip())
    return match.lastgroup if match else None


def plain(cell: str) -> str:
    """A cell without blanks and quotes around it."""
    return cell.strip(" \t\r\n\"'")


def _as_time(name: str) -> str | None:
    """The unit that a name of times says, empty for none; None where it is of something else."""
    match = _TIME.fullmatch(name)
    if match is None:
        # A unit alone; `s` may be a sign.
        return unit_of(name) if len(name) > 1 else None
    unit = unit_of(match["inside"] or match["behind"] or match["short"] or "")
    return None if match["behind"] and unit is None else unit or ""


def unit_named(text: str) -> str:
    """A unit of times that somebody names, for `split_options`."""
    if text not in UNITS_US:
        raise ValueError(", ".join(UNITS_US))
    return text


def fields_of_values(columns: Sequence[NDArray[Any]]) -> Fields | None:
    """The columns of a table without names, by what is in them: two, or four with places, or one more.

    One more may number the rows, or be the same in all.

    Polarities are two values at most, times rise or have decimals; None where that does not tell them apart.

    Args:
        columns: Some rows of each, numbers or words, (n,).

    >>> fields_of_values([np.array([1, 0, 1]), np.array([7, 9, 12])])
    Fields(time=1, polarity=0, places=None, unit=None)
    >>> fields_of_values([np.array(c) for c in ([0, 1], [1, 1], [1, 0], [70_000, 90_000])]).which
    (3, 2, 0, 1)
    """
    numeric = [column.dtype.kind in "iuf" for column in columns]
    kept = list(range(len(columns)))
    if len(columns) in (3, 5):
        kept = [k for k in kept if not (numeric[k] and _counts(columns[k]))]
        if len(kept) == len(columns):
            kept = [k for k in kept if (columns[k] != columns[k][0]).any()]
    signs = [k for k in kept if _are_signs(columns[k]) and all(numeric[j] for j in kept if j != k)]
    if len(kept) not in (2, 4) or not signs:
        return None
    # Where places are 0 and 1, too, polarities are the last ones.
    times = rest = [k for k in kept if k != signs[-1]]
    if len(rest) > 1:
        # Of small whole numbers throughout, times are those that rise.
        rising = [k for k in rest if (np.diff(columns[k].astype(np.float64)) >= 0).all()]
        times = [k for k in rest if not _are_places(columns[k])] or rising
    if len(times) != 1:
        return None
    places = [k for k in rest if k != times[0]]
    return Fields(times[0], signs[-1], (places[0], places[1]) if places else None)


def _counts(column: NDArray[Any]) -> bool:
    """Whether numbers are those of the rows."""
    return len(column) > 1 and bool((np.diff(column.astype(np.float64)) == 1).all())


def _are_places(column: NDArray[Any]) -> bool:
    return bool((column == np.floor(column)).all() and column.min() >= 0 and column.max() < 1 << 16)


def _are_signs(values: NDArray[Any]) -> bool:
    if values.dtype.kind == "b":
        return True
    if values.dtype.kind in "US":
        return all(is_polarity(_word(word)) for word in np.unique(values).tolist())
    return any(np.isin(values, pair).all() for pair in _LEVELS)


def time_unit(
    times: NDArray[Any], named: str | None, share: float = 1.0, *, placed: bool = False
) -> TimeUnit:
    """The unit of times: the one that is named, or else that in which something blinks, or what cameras do.

    That something blinks in another one than is named is said.

    Lights blink at 100 to 60 000 chips a second, which is less than a thousandfold: of units a thousandfold
    apart one alone shows it. Where nothing blinks, times since 1970 say their unit by themselves; and a
    camera counts microseconds, whole ones: nanoseconds of one are multiples of 1000, milliseconds have three
    decimals, seconds six. A unit by which fewer than 20 or more than 50 million events come a second, or 500
    million of a whole sensor, is another one. Where a list of one light would be over in an instant, or its
    events come by the million, and would not in a unit a thousand times as long, its times were rounded.

    Args:
        times: The first ones, in any order, int64 or float64 (n,).
        named: The unit of the name; None for none.
        share: Of all times, those that these are.
        placed: They are events of many pixels.

    >>> time_unit(np.array([0.000125, 0.000893, 0.00131]), None).name
    's'
    >>> time_unit(np.array([125, 893, 1310]), None).name
    'us'
    >>> time_unit(np.array([1_600_000_000_125_000, 1_600_000_000_893_100]), None).name
    'us'
    >>> time_unit(np.array([0.125, 0.126, 0.131] * 100), None).name
    's'
    """
    inside = np.sort(times[np.isfinite(times)])
    span, most_hz = float(np.ptp(inside)) if len(inside) else 0.0, MOST_PLACED_HZ if placed else MOST_RATE_HZ
    rates_hz = {
        unit: (len(inside) - 1) / (span * length_us * 1e-6) if span > 0 else LEAST_RATE_HZ
        for unit, length_us in UNITS_US.items()
    }
    likely = tuple(unit for unit, rate in rates_hz.items() if span > 0 and LEAST_RATE_HZ <= rate <= most_hz)
    blinks = _blinking_unit(inside)
    if named is not None:
        unit, rate_hz = blinks or (named, 0.0)
        why = f", but in {unit} a light would blink, a line at {rate_hz:.4g} Hz"
        sure = unit == named
        return TimeUnit(named, "as its column says" + ("" if sure else why), sure=sure)
    if blinks is not None:
        unit, rate_hz = blinks
        return TimeUnit(unit, f"guessed: a light blinks, a line at {rate_hz:.4g} Hz", likely)
    for unit, length_us in UNITS_US.items():
        # Whole microseconds of twenty minutes on are no seconds of today: those lie near one another.
        near = unit != "s" or span < 1e6
        ends_s = inside[[0, -1]] * (length_us * 1e-6) if len(inside) and near else np.zeros(1)
        if _EPOCH_S[0] < ends_s[0] and ends_s[-1] < _EPOCH_S[1]:
            return TimeUnit(unit, "guessed: times since 1970")
    return _unit_of_digits(inside, rates_hz, likely, share, placed)


def _unit_of_digits(
    inside: NDArray[Any], rates_hz: dict[str, float], likely: tuple[str, ...], share: float, placed: bool
) -> TimeUnit:
    """The unit of which times show the digits, or the next one, if events would be too close or too far."""
    most_hz = MOST_PLACED_HZ if placed else MOST_RATE_HZ
    whole, since = bool((inside == np.round(inside)).all()), inside - inside[:1]
    if whole and since.any() and (since % 1000 == 0).all() and rates_hz["ns"] <= most_hz:
        shown, digits = "ns", "whole numbers, multiples of 1000"
    elif whole:
        shown, digits = "us", "whole numbers"
    elif np.abs(inside * 1e3 - np.round(inside * 1e3)).max() < 1e-4:
        shown, digits = "ms", "3 decimals"
    else:
        shown, digits = "s", "6 decimals or more"
    units = list(UNITS_US)
    at = units.index(shown)
    if at:
        longer, (least_hz, sure_hz) = units[at - 1], _SURE_RATE_HZ
        if placed:
            too_close = rates_hz[shown] > most_hz and longer in likely
        else:
            least_s = share * (_LEAST_COUNTED_S if shown == "us" else _LEAST_SPAN_S)
            too_close = rates_hz[shown] > sure_hz or (len(inside) - 1) / rates_hz[shown] < least_s
            too_close &= least_hz <= rates_hz[longer] <= sure_hz
        if too_close:
            return TimeUnit(longer, f"guessed: {digits}, too close for {shown}", likely)
    # Decimals are of no nanosecond.
    shorter, last = (units[at:], shown) if whole else (units[at:-1], "us")
    unit = next((unit for unit in shorter if rates_hz[unit] >= LEAST_RATE_HZ), last)
    why = f", too far apart for {shown}" if unit != shown else ""
    why += f", {rates_hz[unit]:.3g} events/s" if unit in likely else ""
    return TimeUnit(unit, f"guessed: {digits}{why}", likely)


def _blinking_unit(inside: NDArray[Any]) -> tuple[str, float] | None:
    """The unit in which a light blinks, and the line of its spectrum, Hz; None where none does, or two do."""
    lines = (_line_of(inside * factor, unit) for unit, factor in UNITS_US.items())
    found = sorted((line for line in lines if line is not None), reverse=True)
    if not found or found[0][0] < _LINE or (len(found) > 1 and found[0][0] < _CLEARLY * found[1][0]):
        return None
    return found[0][1], found[0][2]


def _line_of(t_us: NDArray[Any], unit: str) -> tuple[float, str, float] | None:
    """The strongest line in how many events come: over what is around it, the unit, its frequency, Hz.

    Periods below sixteen steps of the times, or above an eighth of their span, say nothing.
    """
    steps = np.diff(np.unique(t_us))
    if not len(steps):
        return None
    since_us = t_us - t_us[0]
    high_hz = min(_BLINKS_HZ[1], 1e6 / (16 * float(steps.min())))
    low_hz = max(_BLINKS_HZ[0], 8e6 / float(since_us[-1]))
    if not 1.5 * low_hz <= high_hz or not math.isfinite(float(since_us[-1]) / float(steps.min())):
        return None
    # Whole steps: others would beat with them.
    bin_us = float(steps.min()) * max(int(1e6 / (4 * high_hz) / float(steps.min())), 1)
    bins = min(int(since_us[-1] / bin_us), _MOST_BINS) + 1
    counted = np.bincount(np.minimum(since_us / bin_us, bins).astype(np.int64), minlength=bins + 1)[:bins]
    power = np.abs(np.fft.rfft((counted - counted.mean()) * np.hanning(bins))) ** 2
    frequency_hz = np.fft.rfftfreq(bins, bin_us * 1e-6)
    around = np.maximum(_medians(power), 1e-9 * power.max() + 1e-30)
    over = np.where((frequency_hz >= low_hz) & (frequency_hz <= high_hz), power / around, 0.0)
    best = int(over.argmax())
    return float(over[best]), unit, float(frequency_hz[best])


def _medians(power: NDArray[np.float64]) -> NDArray[np.float64]:
    """The median of the hundred values on either side, at each hundredth; between these a straight line."""
    middles = np.arange(0, len(power), 100)
    medians = [np.median(power[max(k - 100, 0) : k + 101]) for k in middles]
    return np.interp(np.arange(len(power)), middles, medians)


class Polarities:
    """What numbers or words mean: ON or OFF, by all that a column has shown so far.

    Numbers are 0 and 1, -1 and 1, 1 and 2, 0 and 255, or 1 and 255, which is -1 in eight bits.
    """

    def __init__(self) -> None:
        self._levels: frozenset[float] = frozenset()

    def of(self, values: NDArray[Any]) -> NDArray[np.uint8]:
        """Polarities, uint8 (n,).

        Raises:
            RowError: One is none of them, or does not go with those before.

        >>> Polarities().of(np.array(["ON", "off"])).tolist()
        [1, 0]
        >>> Polarities().of(np.array([2, 1, 1])).tolist()
        [1, 0, 0]
        """
        if values.dtype.kind in "US":
            return self._of_words(values)
        found, first = np.unique(values, return_index=True)
        pair = _LEVELS[0]
        for level, row in sorted(zip(found.tolist(), first.tolist(), strict=True), key=lambda one: one[1]):
            known = self._levels | {level}
            fits = next((pair for pair in _LEVELS if known <= set(pair)), None)
            if fits is None:
                beside = " and ".join(f"{other:g}" for other in sorted(self._levels))
                beside = f" beside {beside}" if beside else ""
                raise RowError(
                    row, f"polarity {level:g}{beside}, expected 0 and 1, or -1 and 1, 1 and 2, 0 and 255"
                )
            self._levels, pair = known, fits
        return np.asarray(values == pair[1], np.uint8)

    @staticmethod
    def _of_words(values: NDArray[Any]) -> NDArray[np.uint8]:
        words, which = np.unique(values, return_inverse=True)
        texts = [_word(word) for word in words.tolist()]
        for k, text in enumerate(texts):
            if not is_polarity(text):
                row = int((which.ravel() == k).argmax())
                raise RowError(row, f"polarity {text!r}, expected 0 or 1, or -1 or 1, or ON or OFF")
        return np.array([_lowered(text) in _ON for text in texts], np.uint8)[which.ravel()]


def _word(value: str | bytes) -> str:
    return plain(value.decode("utf-8", "replace") if isinstance(value, bytes) else value)


def _lowered(text: str) -> str:
    return text.lower().removesuffix(".0")


def is_polarity(text: str) -> bool:
    """Whether a word means ON or OFF."""
    return _lowered(text) in _ON | _OFF
