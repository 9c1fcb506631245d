"""Whose fault it is when a stage of the receiver fails, or gives what the next one cannot work with.

Kernels read and write where what they are given says, so all of it is checked before they see it.
"""

import math
import traceback
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.errors import ConfigError, PluginError
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.plugin.roles import Filter, Tracker
from evlcp_sdk.suggestions import add_check_hint
from evlcp_sdk.values import Curvature, PresenceMap, Range, SoftSymbols, SyncLock

_FAR_PACKETS = 64
"""Packets between a lock and the time when it is found; the grid of its packets is counted from it."""

_FARTHEST_M = 1e15
"""Distance that a pixel's fraction of a billionth shows; beyond is no number of a measurement."""


class Guard:
    """A context in which code of one algorithm runs: what it raises becomes a `PluginError` that names it.

    Interrupts pass, and `ConfigError` where an algorithm may refuse its configuration. The original exception
    is the cause. What an algorithm gave is checked by `expect` and its like, which raise one that says what
    it gave, and what was expected.

    Args:
        link: The configuration that names the algorithm.
        role: Its role.
        may_refuse: Whether it is compiled there: a stream is no place to refuse a configuration.

    Attributes:
        checks: Whether what it gives is to be checked: not what comes with the SDK, whose tests do.

    >>> from evlcp_sdk.link.resolve import load_link
    >>> with Guard(load_link(), "ranging"):
    ...     {}["boom"]
    Traceback (most recent call last):
    evlcp_sdk.errors.PluginError: ranging algorithm 'joint-scale': KeyError: 'boom' (...
    """

    def __init__(self, link: Link, role: str, *, may_refuse: bool = False) -> None:
        id = link.table[role]["id"]
        # To exit is not an algorithm's to decide; to interrupt is the user's.
        passes: list[type[BaseException]] = [PluginError, KeyboardInterrupt]
        self._passes = (*passes, ConfigError) if may_refuse else tuple(passes)
        self._role, self._id = role, id
        self.checks = role not in link.built_in

    def __enter__(self) -> None:
        return None

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        if fault is not None:
            self.blame(fault)

    def blame(self, fault: BaseException) -> None:
        """Name the algorithm that raised something: where a context would cost time.

        Raises:
            PluginError: It does not pass.
        """
        if not isinstance(fault, self._passes):
            raise PluginError(self._message(f": {fault_text(fault)}")) from fault

    def refuse(self, gave: str, expected: str) -> NoReturn:
        """Raise what an algorithm gave, and what was expected, in words."""
        raise PluginError(self._message(f": gave {gave}, expected {expected}"))

    def _message(self, what: str) -> str:
        return add_check_hint(f"{self._role} algorithm '{self._id}'{what}", self._role, self._id)

    def expect(self, found: object, kind: type) -> None:
        """Check the type of what an algorithm gave."""
        if not isinstance(found, kind):
            self.refuse(type(found).__name__, kind.__name__)

    def expect_compiled(self, found: object, methods: tuple[str, ...]) -> None:
        """Check what `compile` gave: an object with these methods, or a function if there are none."""
        if methods and not all(callable(getattr(found, name, None)) for name in methods):
            expected = f"an object with {' and '.join(f'{name}()' for name in methods)}"
        elif not methods and not callable(found):
            expected = "a function"
        else:
            return
        self.refuse(f"{type(found).__name__} at compile()", expected)

    def expect_step(self, found: object, what: str) -> tuple[Any, list[Any]]:
        """Check what a step function gave: its new state, and a list."""
        if not isinstance(found, tuple) or len(found) != 2:
            self.refuse(f"{type(found).__name__} at {what}", "the state and a list")
        state, some = found
        self.expect(some, list)
        return state, some

    def expect_array(self, found: object, name: str, shape: tuple[int, ...], kinds: str) -> None:
        """Check an array's shape, and its type by NumPy's letters for kinds, e.g. `"iu"`."""
        if not isinstance(found, np.ndarray):
            self.refuse(f"{name} of type {type(found).__name__}", f"an array {shape}")
        if found.shape != shape:
            self.refuse(f"{name} of shape {found.shape}", f"{shape}")
        if found.dtype.kind not in kinds:
            self.refuse(f"{name} of {found.dtype}", " or ".join(_KINDS[kind] for kind in kinds))

    def expect_number(
        self, found: object, name: str, least: float, most: float, expected: str | None = None
    ) -> None:
        """Check a number; `expected` says its range where the limits themselves would say it badly."""
        try:
            fine = bool(least <= found <= most)  # type: ignore[operator]
        except (TypeError, ValueError):
            fine = False
        if not fine:
            self.refuse(
                f"{name} = {_shown(repr, found):.40}", expected or f"a number from {least:g} to {most:g}"
            )

    def expect_locks(self, locks: list[SyncLock], until_us: float, packet: PacketFormat) -> None:
        """Check the locks of a step that ends at a time, us: no more than there is time for, near to it."""
        self.expect(locks, list)
        if len(locks) > _MOST_LOCKS:
            self.refuse(f"{len(locks)} locks in a step", f"at most {_MOST_LOCKS}")
        chip_us, whole_us = packet.chip_us, packet.packet_chips * packet.chip_us
        far_us = _FAR_PACKETS * whole_us
        ranges = {
            "chip_us": (chip_us / 2, chip_us * 2),
            "packet_t_us": (until_us - far_us, until_us + far_us),
            "delay_on_us": (-whole_us, whole_us),
            "delay_off_us": (-whole_us, whole_us),
            "quality": (0.0, _ONE),
            "row_us": (-chip_us, chip_us),
            "last_row_us": (-whole_us, whole_us),
        }
        for lock in locks:
            self.expect(lock, SyncLock)
            for name, (least, most) in ranges.items():
                self.expect_number(getattr(lock, name), name, least, most)

    def expect_presence(self, found: PresenceMap, clusters: int, height: int, width: int) -> None:
        """Check what a separation gave of an image."""
        self.expect(found, PresenceMap)
        grid = found.grid_px
        if not isinstance(grid, int | np.integer) or grid < 1:
            self.refuse(f"grid_px = {_shown(repr, grid):.40}", "a whole number of pixels from 1")
        cells = (clusters, height // grid, width // grid)
        self.expect_array(found.probability, "probability", cells, "f")
        self.expect_array(found.selected, "selected", cells, "b")
        self.expect_array(found.pixels, "pixels", (clusters, height, width), "f")
        if found.prior is not None:
            self.expect_array(found.prior, "prior", cells, "f")
        if not _all_within(found.probability, 0.0, _ONE):
            self.refuse("probability of other values", "0 to 1")
        most = float(np.finfo(found.pixels.dtype).max)
        if not _all_within(found.pixels, -most, most):
            self.refuse("pixels of other values", "finite ones")

    def expect_symbols(self, soft: SoftSymbols, codebook: Codebook) -> None:
        """Check what a decoding gave."""
        self.expect(soft, SoftSymbols)
        self.expect_array(soft.symbols, "symbols", (codebook.clusters,), "iu")
        self.expect_array(soft.llr, "llr", (codebook.clusters, codebook.bits_per_symbol), "f")
        top = len(codebook.codewords) - 1
        symbols = soft.symbols.tolist()
        least, most = min(symbols), max(symbols)
        if least < -1 or most > top:
            self.refuse(f"symbol {least if least < -1 else most}", f"0 to {top}, or -1 for one not given")
        if not math.isfinite(np.add.reduce(soft.llr, axis=None)):
            self.refuse("llr of other values", "finite ones")
        self.expect_number(soft.quality, "quality", 0.0, _ONE)

    def expect_range(self, found: Range) -> None:
        """Check what a ranging gave."""
        self.expect(found, Range)
        if not _unknown(found.distance_m):
            above = f"a number above 0 and up to {_FARTHEST_M:g}, or NaN"
            self.expect_number(found.distance_m, "distance_m", math.ulp(0.0), _FARTHEST_M, above)
        if not _unknown(found.sigma_m):
            self.expect_number(found.sigma_m, "sigma_m", 0.0, math.inf, "a number from 0, or NaN")
        self.expect_number(found.pairs, "pairs", 0, 1 << 32)
        self.expect_number(found.late_chips, "late_chips", -_LATEST_CHIPS, _LATEST_CHIPS)
        if found.curvature is not None:
            self.expect(found.curvature, Curvature)
            shape = np.shape(found.curvature.place)
            for name in ("place", "offset", "weight"):
                self.expect_array(getattr(found.curvature, name), f"curvature.{name}", shape, "f")
            if found.curvature.phase_bias is not None:
                self.expect_array(found.curvature.phase_bias, "curvature.phase_bias", shape, "f")
            self.expect_number(
                found.curvature.phase_bias_m, "curvature.phase_bias_m", -_FARTHEST_M, _FARTHEST_M
            )
            if not _unknown(found.curvature.spacing_px):
                self.expect_number(found.curvature.spacing_px, "curvature.spacing_px", 0.0, math.inf)
                self.expect_number(found.curvature.unit_px, "curvature.unit_px", 0.0, math.inf)
            if len(shape) != 1:
                self.refuse(f"curvature.place of shape {shape}", "one number a boundary")

    def expect_filtered(self, values: object, sigma: object, shape: tuple[int, ...]) -> None:
        """Check what a filter of tracking gave: finite values of this shape, and a sigma."""
        self.expect_array(values, "values", shape, "f")
        assert isinstance(values, np.ndarray)
        if not math.isfinite(values.sum()):
            self.refuse(f"values {values.tolist()!r:.40}", "finite ones")
        if not _unknown(sigma):
            self.expect_number(sigma, "sigma", 0.0, math.inf)


def fault_text(fault: BaseException) -> str:
    """What was raised in the code of a plugin, in one line, and where."""
    last = traceback.extract_tb(fault.__traceback__)[-1]
    what = f"{type(fault).__name__}: {_shown(str, fault)}".splitlines()[0]
    return f"{what} ({Path(last.filename).name}, line {last.lineno})"


def compiled(link: Link, role: str, *given: object, methods: tuple[str, ...] = ()) -> Any:
    """What a link's algorithm of a role compiles to: a function, or an object with these methods.

    Raises:
        ConfigError: It refuses the link.
        PluginError: It fails, or gives something else.
    """
    guard = Guard(link, role, may_refuse=True)
    with guard:
        found = link.algorithm(role).compile(*given)
        guard.expect_compiled(found, methods)
    return found


def tracker_of(link: Link) -> Tracker:
    """The filters of a link's tracking, whose faults are named."""
    guard = Guard(link, "tracking", may_refuse=True)
    with guard:
        tracker: Tracker = link.algorithm("tracking").compile()
        guard.expect(tracker, Tracker)
        for filter_ in (tracker.position, tracker.distance):
            if filter_ is not None:
                guard.expect_compiled(filter_, ("init", "step", "predict"))
    guard = Guard(link, "tracking")
    filters = tracker.position, tracker.distance
    return Tracker(*(None if one is None else _GuardedFilter(one, guard) for one in filters))


class _GuardedFilter(Filter):
    """A filter of tracking whose faults are named."""

    def __init__(self, filter_: Filter, guard: Guard) -> None:
        self._filter = filter_
        self._guard = guard

    def init(self) -> Any:
        with self._guard:
            return self._filter.init()

    def predict(self, state: Any, t_us: float) -> tuple[NDArray[np.float64], float] | None:
        with self._guard:
            found = self._filter.predict(state, t_us)
            if found is not None:
                values, sigma = found
                self._guard.expect_filtered(values, sigma, np.shape(values)[:1])
        return found

    def step(
        self, state: Any, t_us: float, value: NDArray[np.float64], sigma: float
    ) -> tuple[Any, NDArray[np.float64], float]:
        with self._guard:
            state, values, sigma = self._filter.step(state, t_us, value, sigma)
            self._guard.expect_filtered(values, sigma, value.shape)
        return state, values, sigma


def _all_within(found: NDArray[np.floating[Any]], least: float, most: float) -> bool:
    """Whether none of some values is NaN, less than `least` or more than `most`."""
    # With a NaN among them, the smallest and the largest are NaN.
    return bool(found.min(initial=least) >= least and found.max(initial=least) <= most)


def _unknown(value: object) -> bool:
    try:
        return math.isnan(value)  # type: ignore[arg-type]
    except (TypeError, OverflowError):
        return False


def _shown(form: Callable[[object], str], what: object) -> str:
    """As `str` or `repr` has it, where that fails (integers of 5000 digits, code of a plugin), the type."""
    try:
        return form(what)
    except Exception:
        return f"a {type(what).__name__} that cannot be shown"


_KINDS = {"f": "floats", "b": "booleans", "i": "integers", "u": "unsigned ones"}
_MOST_LOCKS = 1000
"""A step of 1.5 ms has room for fifty packets of thirty chips at a million chips a second."""
_ONE = 1 + 1e-5
"""Rounding of 32 bits is no fault."""
_LATEST_CHIPS = 1e6
