"""What the columns of somebody's list of events mean: names, units of time, words for polarities."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.io.writers import LAST_TIME_US

__all__ = [
    "Fields",
    "RowError",
    "TimeUnit",
    "fields_of",
    "fields_of_values",
    "polarities",
    "time_unit",
    "unit_of",
]

UNITS_US: Final = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}

_UNITS: Final = {
    "s": "s|secs?|seconds?",
    "ms": "ms|msecs?|millis|milliseconds?",
    "us": "us|µs|μs|usecs?|micros|microseconds?",
    "ns": "ns|nsecs?|nanos|nanoseconds?",
}
_UNIT: Final = re.compile(
    "(?:in )?(?:" + "|".join(f"(?P<{unit}>{words})" for unit, words in _UNITS.items()) + ")"
)
_BRACKETS: Final = re.compile(r"(.*?)[ _.]*[(\[]([^()\[\]]*)[)\]]")
_WITH_UNIT: Final = re.compile(r"(.+?)(?:[ _.]in)?(?:[ _.]+|[ _.]*/[ ]?)([^ _./]+)")
_SHORT_UNIT: Final = re.compile(r"(.+?)(ms|us|ns)")
_TIME: Final = re.compile(
    r"(?:(?:events?|elapsed)[ _.]?)?(?:t|ts|times?|timestamps?|time[ _]stamps?)(?:[ _.]events?)?"
)
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
    """

    name: str
    why: str
    others: tuple[str, ...] = ()

    @property
    def guess(self) -> str:
        """What was guessed, in words; empty where the unit is known."""
        if not self.why.startswith("guessed"):
            return ""
        others = [unit for unit in self.others if unit != self.name]
        return f"times in {self.name}, {self.why}" + (f"; {' or '.join(others)} would do" if others else "")

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
            if times.dtype.itemsize < 8:
                # Fewer digits than a microsecond needs: the nearest one.
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

    def behind(self, many: int) -> "Fields":
        """The same behind so many other columns."""
        places = (self.places[0] + many, self.places[1] + many) if self.places else None
        return Fields(self.time + many, self.polarity + many, places, self.unit)


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
    plain = [_plain(name) for name in names]
    times = [(k, said) for k, name in enumerate(plain) if (said := _as_time(name)) is not None]
    bare = [match[1] if (match := _BRACKETS.fullmatch(name)) else name for name in plain]
    found = {key: [k for k, name in enumerate(bare) if word.fullmatch(name)] for key, word in _NAMES.items()}
    # `t` and `p` before longer names that may mean something else.
    if len(times) > 1:
        times = [one for one in times if bare[one[0]] in ("t", "ts", "time", "timestamp")]
    of_p = found["p"] or [k for k, name in enumerate(bare) if name in _EVENT]
    if len(of_p) > 1:
        of_p = [k for k in of_p if bare[k] in ("p", "pol", "polarity")]
    if len(times) != 1 or len(of_p) != 1:
        return None
    (time, unit), (polarity,) = times[0], of_p
    places = (found["x"][0], found["y"][0]) if len(found["x"]) == len(found["y"]) == 1 else None
    return Fields(time, polarity, places, unit or None)


def unit_of(name: str) -> str | None:
    """The unit that a word says, perhaps in brackets; None where it says none.

    >>> unit_of("[microseconds]"), unit_of("p")
    ('us', None)
    """
    match = _UNIT.fullmatch(_plain(name).strip("()[]").strip())
    return next((unit for unit in _UNITS if match[unit]), None) if match else None


def _plain(name: str) -> str:
    return name.strip().strip("\"'").strip().lower()


def _as_time(name: str) -> str | None:
    """The unit that a name of times says, empty for none; None where it is of something else."""
    if _TIME.fullmatch(name):
        return ""
    for form in (_BRACKETS, _WITH_UNIT, _SHORT_UNIT):
        match = form.fullmatch(name)
        if match and _TIME.fullmatch(match[1]):
            unit = unit_of(match[2])
            return unit if unit or form is not _BRACKETS else ""
    # A unit alone; `s` may be a sign.
    return unit_of(name) if len(name) > 1 else None


def fields_of_values(columns: Sequence[NDArray[Any]]) -> Fields | None:
    """The columns of a table without names, by what is in them: two, or four with places, or one more.

    One more may number the rows, or be the same in all.

    Polarities are two values at most, times rise or have decimals; None where that does not tell them apart.

    Args:
        columns: Some rows of each, numbers or words, (n,).

    >>> fields_of_values([np.array([1, 0, 1]), np.array([7, 9, 12])])
    Fields(time=1, polarity=0, places=None, unit=None)
    """
    if len(columns) in (3, 5):
        # One that counts the rows, or is the same in all, says nothing.
        kept = [k for k, column in enumerate(columns) if not _counts_rows(column)]
        if len(kept) == len(columns):
            kept = [k for k, column in enumerate(columns) if (column != column[0]).any()]
        found = fields_of_values([columns[k] for k in kept]) if len(kept) == len(columns) - 1 else None
        if found is None:
            return None
        places = (kept[found.places[0]], kept[found.places[1]]) if found.places else None
        return Fields(kept[found.time], kept[found.polarity], places)
    signs = [k for k, column in enumerate(columns) if _are_signs(column)]
    if len(columns) == 2:
        if not signs:
            return None
        if len(signs) == 1:
            return Fields(1 - signs[0], signs[0])
        return Fields(0, 1) if columns[0].dtype.kind in "iuf" else Fields(1, 0)
    if len(columns) != 4 or not signs:
        return None
    # The last one, or the last but one, where places are 0 and 1, too.
    rest = [k for k in range(4) if k not in signs] if len(signs) == 1 else list(range(4))
    if len(signs) > 1:
        signs = [k for k in signs if k >= 2][-1:] or signs[-1:]
        rest = [k for k in range(4) if k != signs[0]]
    numbers = [k for k in rest if columns[k].dtype.kind in "iuf"]
    if len(numbers) < 3:
        return None

    def is_place(column: NDArray[Any]) -> bool:
        return bool((column == np.floor(column)).all() and column.min() >= 0 and column.max() < 1 << 16)

    times = [k for k in rest if not is_place(columns[k])]
    if not times:
        # Small whole numbers throughout: the one that rises.
        times = [k for k in rest if (np.diff(columns[k].astype(np.float64)) >= 0).all()]
    if len(times) != 1:
        return None
    x, y = (k for k in rest if k != times[0])
    return Fields(times[0], signs[0], (x, y))


def _counts_rows(values: NDArray[Any]) -> bool:
    return values.dtype.kind in "iuf" and len(values) > 2 and bool((np.diff(values.astype(float)) == 1).all())


def _are_signs(values: NDArray[Any]) -> bool:
    if values.dtype.kind == "b":
        return True
    if values.dtype.kind in "US":
        return all(str(word).strip().lower() in _ON | _OFF for word in np.unique(values).tolist())
    return bool(np.isin(values, (-1, 0, 1)).all())


def time_unit(times: NDArray[Any], named: str | None, share: float = 1.0) -> TimeUnit:
    """The unit of times: the one that their column's name says, or else what cameras do.

    A camera counts microseconds, whole ones: nanoseconds of one are multiples of 1000, milliseconds have
    three decimals, seconds six. A unit by which less than 20 or more than 50 million events come a second is
    another one. Times since 1970 say their unit by themselves. Where a list would be over in an instant, or
    its events come by the million, and would not in a unit a thousand times as long, its times were rounded
    to milliseconds.

    Args:
        times: The first ones, in any order, int64 or float64 (n,).
        named: The unit of the name; None for none.
        share: Of all times, those that these are.

    >>> time_unit(np.array([0.000125, 0.000893, 0.00131]), None).name
    's'
    >>> time_unit(np.array([125, 893, 1310]), None).name
    'us'
    >>> time_unit(np.array([1_600_000_000_125_000, 1_600_000_000_893_100]), None).name
    'us'
    >>> time_unit(np.array([0.125, 0.126, 0.131] * 100), None).name
    's'
    """
    if named is not None:
        return TimeUnit(named, "as its column says")
    inside = np.sort(times[np.isfinite(times)] if times.dtype.kind == "f" else times)
    span = float(inside[-1] - inside[0]) if len(inside) > 1 else 0.0

    def rate_hz(unit: str) -> float:
        return (len(inside) - 1) / (span * UNITS_US[unit] * 1e-6) if span > 0 else LEAST_RATE_HZ

    def likely(unit: str) -> bool:
        return LEAST_RATE_HZ <= rate_hz(unit) <= MOST_RATE_HZ

    def rounded(unit: str, longer: str, least_s: float) -> bool:
        """Whether the longer of two units is likelier, though by it times are of whole milliseconds."""
        least_hz, most_hz = _SURE_RATE_HZ
        short = span * UNITS_US[unit] * 1e-6 < least_s * share
        return span > 0 and (short or rate_hz(unit) > most_hz) and least_hz <= rate_hz(longer) <= most_hz

    for unit in UNITS_US:
        # Whole microseconds of twenty minutes on are no seconds of today: those lie near one another.
        if (
            len(inside)
            and (unit != "s" or span < 1e6)
            and all(
                _EPOCH_S[0] < float(t) * UNITS_US[unit] * 1e-6 < _EPOCH_S[1] for t in (inside[0], inside[-1])
            )
        ):
            return TimeUnit(unit, "guessed: times since 1970")
    others = tuple(unit for unit in UNITS_US if span > 0 and likely(unit))
    if times.dtype.kind != "f" or (inside == np.round(inside)).all():
        whole = inside - inside[:1]
        if span > 0 and (whole % 1000 == 0).all() and rate_hz("ns") <= MOST_RATE_HZ:
            if rounded("ns", "us", _LEAST_SPAN_S):
                return TimeUnit("us", "guessed: whole numbers, multiples of 1000, too close for ns", others)
            return TimeUnit("ns", "guessed: whole numbers, all multiples of 1000", others)
        if rounded("us", "ms", _LEAST_COUNTED_S):
            return TimeUnit("ms", "guessed: whole numbers, too close for us", others)
        if not likely("us") and likely("ns"):
            return TimeUnit("ns", "guessed: whole numbers, too far apart for us", others)
        return TimeUnit("us", "guessed: whole numbers", others)
    decimals = 3 if np.abs(inside * 1e3 - np.round(inside * 1e3)).max() < 1e-4 else 6
    if decimals == 3 and rounded("ms", "s", _LEAST_SPAN_S):
        return TimeUnit("s", "guessed: 3 decimals, too close for ms", others)
    tried = ("ms", "us") if decimals == 3 else ("s", "ms", "us")
    for unit in tried:
        if rate_hz(unit) >= LEAST_RATE_HZ:
            why = f"guessed: {decimals} decimals or more, {rate_hz(unit):.3g} events/s"
            return TimeUnit(unit, why, others)
    return TimeUnit("us", "guessed: too far apart for ms", others)


def polarities(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Polarities of 0 and 1, -1 and 1, false and true, or words such as ON and OFF, uint8 (n,).

    Raises:
        RowError: One is none of them.

    >>> polarities(np.array(["ON", "off"])).tolist()
    [1, 0]
    """
    if values.dtype.kind in "US":
        words = {}
        for word in np.unique(values).tolist():
            text = (word.decode("utf-8", "replace") if isinstance(word, bytes) else word).strip().strip("\"'")
            plain = text.lower().removesuffix(".0")
            if plain not in _ON and plain not in _OFF:
                row = int((values == word).argmax())
                raise RowError(row, f"polarity {text!r}, expected 0 or 1, or -1 or 1, or ON or OFF")
            words[word] = plain in _ON
        kinds, which = np.unique(values, return_inverse=True)
        return np.array([words[kind] for kind in kinds.tolist()], np.uint8)[which.ravel()]
    wrong = ~np.isin(values, (-1, 0, 1))
    if wrong.any():
        row = int(wrong.argmax())
        raise RowError(row, f"polarity {values[row]}, expected 0 or 1, or -1 or 1")
    return (values > 0).astype(np.uint8)
