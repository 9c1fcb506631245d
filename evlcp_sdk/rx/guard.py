"""Names the algorithm at fault when a stage of the receiver fails, or gives what the next one cannot use.

Kernels read and write by index, so that all values are checked before they see them.
"""

import math
from types import TracebackType
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.errors import ConfigError, PluginError, describe_plugin_fault
from evlcp_sdk.formatting import add_check_hint, format_safely
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.plugin.roles import Filter, Tracker
from evlcp_sdk.values import Curvature, PresenceMap, Range, SoftSymbols, SyncLock

_MAX_LOCK_PACKETS = 64
"""Packets between a lock and the time when it is found; the grid of its packets is counted from it."""

_MAX_DISTANCE_M = 1e15
"""A distance that would be a billionth of a pixel; beyond is no measurement."""

_KINDS = {"f": "floats", "b": "booleans", "i": "integers", "u": "unsigned ones"}

_MAX_LOCKS = 1000
"""A step of 1.5 ms has room for fifty packets of thirty chips at a million chips a second."""

_ONE_ROUNDED = 1 + 1e-5
"""Rounding of 32 bits is no fault."""

_MAX_LATE_CHIPS = 1e6


class Guard:
    """A context in which code of one algorithm runs: what it raises becomes a `PluginError` that names it.

    Interrupts pass, and `ConfigError` where an algorithm may refuse its configuration, when it is compiled: a
    stream is no place for that. The original exception is the cause. `expect` and its like check what an
    algorithm gave, and raise an error that shows it.

    Attributes:
        checks: Whether its values are to be checked: not those of the SDK's own, which tests check.

    >>> from evlcp_sdk.link.resolve import load_link
    >>> with Guard(load_link(), "ranging"):
    ...     {}["boom"]
    Traceback (most recent call last):
    evlcp_sdk.errors.PluginError: ranging algorithm 'joint-scale': KeyError: 'boom' (...
    """

    def __init__(self, link: Link, role: str, *, may_refuse: bool = False) -> None:
        # An algorithm may not exit; a user may interrupt.
        allowed: tuple[type[BaseException], ...] = PluginError, KeyboardInterrupt
        self._allowed = (*allowed, ConfigError) if may_refuse else allowed
        self._role, self._id = role, link.table[role]["id"]
        self.checks = role not in link.built_in

    def __enter__(self) -> None:
        return None

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        if fault is not None:
            self.reraise(fault)

    def reraise(self, fault: BaseException) -> None:
        """Raise a fault of the algorithm by its name: used where a context would cost time.

        Raises:
            PluginError: Unless the fault may pass as it is.
        """
        if not isinstance(fault, self._allowed):
            raise PluginError(self._error_text(f": {describe_plugin_fault(fault)}")) from fault

    def refuse(self, gave: str, expected: str) -> NoReturn:
        """Raise an error with what the algorithm gave and what was expected."""
        raise PluginError(self._error_text(f": gave {gave}, expected {expected}"))

    def _error_text(self, what: str) -> str:
        return add_check_hint(f"{self._role} algorithm '{self._id}'{what}", self._role, self._id)

    def expect(self, found: object, kind: type) -> None:
        """Check the type of a value."""
        if not isinstance(found, kind):
            self.refuse(type(found).__name__, kind.__name__)

    def expect_compiled(self, found: object, methods: tuple[str, ...]) -> None:
        """Check what `compile` gave: an object with these methods, or a function without any."""
        if methods and not all(callable(getattr(found, name, None)) for name in methods):
            expected = f"an object with {' and '.join(f'{name}()' for name in methods)}"
        elif not methods and not callable(found):
            expected = "a function"
        else:
            return
        self.refuse(f"{type(found).__name__} at compile()", expected)

    def expect_step(self, found: object, what: str) -> tuple[Any, list[Any]]:
        """Check what a step function gave, its new state and a list; return both."""
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
        """Check a number; `expected` describes its range where the limits would not."""
        try:
            fine = bool(least <= found <= most)  # type: ignore[operator]
        except (TypeError, ValueError):
            fine = False
        if not fine:
            self.refuse(
                f"{name} = {format_safely(repr, found):.40}",
                expected or f"a number from {least:g} to {most:g}",
            )

    def expect_locks(self, locks: list[SyncLock], until_us: float, packet: PacketFormat) -> None:
        """Check the locks of a step that ends at a time, us: not too many, and near to it."""
        self.expect(locks, list)
        if len(locks) > _MAX_LOCKS:
            self.refuse(f"{len(locks)} locks in a step", f"at most {_MAX_LOCKS}")
        chip_us, whole_us = packet.chip_us, packet.packet_us
        max_us = _MAX_LOCK_PACKETS * whole_us
        ranges = {
            "chip_us": (chip_us / 2, chip_us * 2),
            "packet_t_us": (until_us - max_us, until_us + max_us),
            "delay_on_us": (-whole_us, whole_us),
            "delay_off_us": (-whole_us, whole_us),
            "quality": (0.0, _ONE_ROUNDED),
            "row_us": (-chip_us, chip_us),
            "last_row_us": (-whole_us, whole_us),
        }
        for lock in locks:
            self.expect(lock, SyncLock)
            for name, (least, most) in ranges.items():
                self.expect_number(getattr(lock, name), name, least, most)

    def expect_presence(self, found: PresenceMap, clusters: int, height: int, width: int) -> None:
        """Check a separation's presence in an image of this size."""
        self.expect(found, PresenceMap)
        grid = found.grid_px
        if not isinstance(grid, int | np.integer) or grid < 1:
            self.refuse(f"grid_px = {format_safely(repr, grid):.40}", "a whole number of pixels from 1")
        cells = (clusters, height // grid, width // grid)
        self.expect_array(found.probability, "probability", cells, "f")
        self.expect_array(found.selected, "selected", cells, "b")
        self.expect_array(found.pixels, "pixels", (clusters, height, width), "f")
        if found.prior is not None:
            self.expect_array(found.prior, "prior", cells, "f")
        if not _are_within(found.probability, 0.0, _ONE_ROUNDED):
            self.refuse("probability of other values", "0 to 1")
        most = float(np.finfo(found.pixels.dtype).max)
        if not _are_within(found.pixels, -most, most):
            self.refuse("pixels of other values", "finite ones")

    def expect_symbols(self, soft: SoftSymbols, codebook: Codebook) -> None:
        """Check a decoding's symbols."""
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
        self.expect_number(soft.quality, "quality", 0.0, _ONE_ROUNDED)

    def expect_range(self, found: Range) -> None:
        """Check a ranging's distance."""
        self.expect(found, Range)
        if not _is_nan(found.distance_m):
            above = f"a number above 0 and up to {_MAX_DISTANCE_M:g}, or NaN"
            self.expect_number(found.distance_m, "distance_m", math.ulp(0.0), _MAX_DISTANCE_M, above)
        if not _is_nan(found.sigma_m):
            self.expect_number(found.sigma_m, "sigma_m", 0.0, math.inf, "a number from 0, or NaN")
        self.expect_number(found.pairs, "pairs", 0, 1 << 32)
        self.expect_number(found.late_chips, "late_chips", -_MAX_LATE_CHIPS, _MAX_LATE_CHIPS)
        if found.curvature is not None:
            self.expect(found.curvature, Curvature)
            shape = np.shape(found.curvature.place)
            for name in ("place", "offset", "weight"):
                self.expect_array(getattr(found.curvature, name), f"curvature.{name}", shape, "f")
            if found.curvature.phase_bias is not None:
                self.expect_array(found.curvature.phase_bias, "curvature.phase_bias", shape, "f")
            self.expect_number(
                found.curvature.phase_bias_m, "curvature.phase_bias_m", -_MAX_DISTANCE_M, _MAX_DISTANCE_M
            )
            if not _is_nan(found.curvature.spacing_px):
                self.expect_number(found.curvature.spacing_px, "curvature.spacing_px", 0.0, math.inf)
                self.expect_number(found.curvature.unit_px, "curvature.unit_px", 0.0, math.inf)
            if len(shape) != 1:
                self.refuse(f"curvature.place of shape {shape}", "one number a boundary")

    def expect_filtered(self, values: object, sigma: object, shape: tuple[int, ...]) -> None:
        """Check a tracking filter's finite values of this shape, and its sigma."""
        self.expect_array(values, "values", shape, "f")
        assert isinstance(values, np.ndarray)
        if not math.isfinite(values.sum()):
            self.refuse(f"values {values.tolist()!r:.40}", "finite ones")
        if not _is_nan(sigma):
            self.expect_number(sigma, "sigma", 0.0, math.inf)


def compile_algorithm(link: Link, role: str, *arguments: object, methods: tuple[str, ...] = ()) -> Any:
    """Compile a link's algorithm of a role: to a function, or an object with these methods.

    Raises:
        ConfigError: It refuses the link.
        PluginError: It fails, or gives something else.
    """
    guard = Guard(link, role, may_refuse=True)
    with guard:
        found = link.algorithm(role).compile(*arguments)
        guard.expect_compiled(found, methods)
    return found


def compile_tracker(link: Link) -> Tracker:
    """Compile a link's tracking to filters whose faults are named."""
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
    """A tracking filter whose faults are named."""

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


def _are_within(found: NDArray[np.floating[Any]], least: float, most: float) -> bool:
    """Whether all values are between two limits; NaN is not."""
    # With a NaN among them, the smallest and the largest are NaN.
    return bool(found.min(initial=least) >= least and found.max(initial=least) <= most)


def _is_nan(value: object) -> bool:
    try:
        return math.isnan(value)  # type: ignore[arg-type]
    except (TypeError, OverflowError):
        return False
