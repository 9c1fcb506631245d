"""The bar: the positions of a transmitter's LEDs, and the cluster of each."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.files import read_table
from evlcp_sdk.formatting import format_value, suggest
from evlcp_sdk.specs import SpecError, build_spec

_MAX_LEDS = 1 << 16

_MAX_M = 100.0
"""Largest distance of an LED from its transmitter's centre."""

_SAME_M = 1e-9
_MAX_GAP_LEDS = 3.0
"""Widest dark gap between clusters, in widths of an LED, that blur fills with their light."""

Floats = NDArray[np.float64]
Leds = tuple[Floats, NDArray[np.int64]]
"""LED centres (x right, y down, z towards the viewer), m, float64 (n, 3), and their clusters, int64 (n,)."""


@dataclass(frozen=True)
class LedGrid:
    """LEDs on a grid of rows and columns, top left first, grouped row by row into equal clusters.

    A bar is one column; a panel of many rows and columns is grouped into blocks of
    `cluster_rows` x `cluster_columns` LEDs, numbered row by row from the top left.

    Raises:
        ConfigError: The blocks do not tile the grid, or it has more than 65536 LEDs.
    """

    rows: Annotated[int, Field(gt=0, le=4096, description="LEDs from top to bottom.")] = 96
    columns: Annotated[int, Field(gt=0, le=4096, description="LEDs from left to right.")] = 1
    led_pitch_m: Annotated[float, Field(ge=1e-6, le=100, description="Spacing of neighbouring LEDs.")] = 0.01
    cluster_rows: Annotated[int, Field(gt=0, description="LED rows of a cluster.")] = 6
    cluster_columns: Annotated[int, Field(gt=0, description="LED columns of a cluster.")] = 1

    def __post_init__(self) -> None:
        _check_count(self.rows * self.columns, f"bar.rows = {self.rows}, bar.columns = {self.columns}")
        for name in ("rows", "columns"):
            _check_divisor(f"cluster_{name}", getattr(self, f"cluster_{name}"), name, getattr(self, name))

    @property
    def led_m(self) -> float:
        """Height that one LED lights, m."""
        return self.led_pitch_m

    def place_leds(self) -> Leds:
        """The LEDs' centres and clusters."""
        y, x = np.mgrid[: self.rows, : self.columns]
        across = self.columns // self.cluster_columns
        cluster_ids = (y // self.cluster_rows) * across + x // self.cluster_columns
        place = np.stack([x - (self.columns - 1) / 2, y - (self.rows - 1) / 2, np.zeros(x.shape)], -1)
        return place.reshape(-1, 3) * self.led_pitch_m, cluster_ids.ravel()


@dataclass(frozen=True)
class LedColumns:
    """Separate columns of LEDs, such as a car's two lamps; clusters are counted down each, column by column.

    Raises:
        ConfigError: Clusters do not tile a column, or there are more than 65536 LEDs.
    """

    columns: Annotated[int, Field(gt=0, le=64, description="How many columns.")] = 2
    apart_m: Annotated[float, Field(ge=1e-6, le=100, description="Spacing of the columns.")] = 0.5
    rows: Annotated[int, Field(gt=0, le=4096, description="LEDs of a column.")] = 48
    led_pitch_m: Annotated[float, Field(ge=1e-6, le=100, description="Spacing of LEDs in a column.")] = 0.01
    cluster_rows: Annotated[int, Field(gt=0, description="LEDs of a cluster.")] = 6

    def __post_init__(self) -> None:
        _check_count(self.rows * self.columns, f"bar.rows = {self.rows}, bar.columns = {self.columns}")
        _check_divisor("cluster_rows", self.cluster_rows, "rows", self.rows)

    @property
    def led_m(self) -> float:
        """Height that one LED lights, m."""
        return self.led_pitch_m

    def place_leds(self) -> Leds:
        """The LEDs' centres and clusters."""
        x, y = np.mgrid[: self.columns, : self.rows]
        place = np.stack(
            [
                (x - (self.columns - 1) / 2) * self.apart_m,
                (y - (self.rows - 1) / 2) * self.led_pitch_m,
                np.zeros(x.shape),
            ],
            -1,
        )
        cluster_ids = x * (self.rows // self.cluster_rows) + y // self.cluster_rows
        return place.reshape(-1, 3), cluster_ids.ravel()


@dataclass(frozen=True)
class LedRing:
    """LEDs evenly on a circle, grouped clockwise from the top as seen from the front.

    Raises:
        ConfigError: Clusters do not tile the ring.
    """

    leds: Annotated[int, Field(gt=0, le=4096, description="LEDs on the circle.")] = 12
    radius_m: Annotated[float, Field(ge=1e-6, le=100, description="From the centre to an LED.")] = 0.25
    cluster_leds: Annotated[int, Field(gt=0, description="Neighbouring LEDs of a cluster.")] = 1
    led_m: Annotated[float, Field(ge=1e-6, le=1, description="Width and height that one LED lights.")] = 0.005

    def __post_init__(self) -> None:
        _check_divisor("cluster_leds", self.cluster_leds, "leds", self.leds)

    def place_leds(self) -> Leds:
        """The LEDs' centres and clusters."""
        number = np.arange(self.leds)
        turn = 2 * np.pi * number / self.leds
        # To the nanometre, so that LEDs opposite each other stand in one row or column.
        place = np.stack([np.sin(turn), -np.cos(turn), 0 * turn], 1) * self.radius_m
        return np.round(place, 9), number // self.cluster_leds


_Metres = Annotated[float, Field(ge=-_MAX_M, le=_MAX_M)]
_Cluster = Annotated[int, Field(ge=0, lt=_MAX_LEDS)]


@dataclass(frozen=True)
class LedTable:
    """Any LEDs: one row each, in any order; clusters of any size, counted from 0.

    Raises:
        ConfigError: There are none or more than 65536, a cluster has no LED or is behind another one.
    """

    leds: Annotated[
        tuple[tuple[_Metres, _Metres, _Metres, _Cluster], ...],
        Field(
            description="LEDs [x, y, z, cluster]: to the right, down, and towards the viewer, m, from the"
            " transmitter's centre."
        ),
    ] = ((0.0, 0.0, 0.0, 0),)
    led_m: Annotated[float, Field(ge=1e-6, le=1, description="Width and height that one LED lights.")] = 0.005

    def __post_init__(self) -> None:
        _check_count(len(self.leds), f"bar.leds: {len(self.leds)} LEDs")
        taken: dict[tuple[int, ...], int] = {}
        for i, led in enumerate(self.leds):
            first = taken.setdefault(tuple(round(value * 1e6) for value in led[:3]), i)
            if first != i:
                raise ConfigError(f"bar.leds.{i}: stands where bar.leds.{first} does, to the micrometre")
        clusters = {led[3] for led in self.leds}
        missing = next((k for k in range(max(clusters)) if k not in clusters), None)
        if missing is not None:
            raise ConfigError(
                f"bar.leds: no LED of cluster {missing}: expected clusters 0 to {max(clusters)}, all of them"
            )

        places: dict[int, set[tuple[int, ...]]] = {}
        for led in self.leds:
            places.setdefault(led[3], set()).add(tuple(round(value * 1e6) for value in led[:2]))
        seen: dict[frozenset[tuple[int, ...]], int] = {}
        for k in sorted(clusters):
            first = seen.setdefault(frozenset(places[k]), k)
            if first != k:
                raise ConfigError(
                    f"bar.leds: cluster {k} is behind cluster {first}, LED by LED: expected clusters that a"
                    " camera in front sees beside one another"
                )

    def place_leds(self) -> Leds:
        """The LEDs' centres and clusters."""
        table = np.array(self.leds, np.float64)
        return table[:, :3].copy(), table[:, 3].astype(np.int64)


Shape = LedGrid | LedColumns | LedRing | LedTable

SHAPES: Mapping[str, type[Shape]] = MappingProxyType(
    {"grid": LedGrid, "columns": LedColumns, "ring": LedRing, "table": LedTable}
)
"""What `bar.shape` names; a grid need not be named."""


@dataclass(frozen=True)
class BarLayout:
    """A transmitter's LEDs and their clusters, whatever shape describes them.

    >>> BarLayout().clusters
    16
    >>> panel = BarLayout(LedGrid(rows=16, columns=16, cluster_rows=4, cluster_columns=4))
    >>> panel.cluster_centres_m()[1].round(3).tolist()
    [-0.02, -0.06]
    >>> BarLayout(LedRing(leds=12)).led_clusters().tolist()
    [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11]
    """

    shape: Shape = field(default_factory=LedGrid)

    @classmethod
    def of_table(cls, table: Mapping[str, Any]) -> "BarLayout":
        """The layout that a link's table `[bar]` describes, with defaults for missing keys.

        Raises:
            SpecError: Keys or values are wrong.
            ConfigError: The values contradict one another.
        """
        keys = dict(table)
        name = keys.pop("shape", "grid")
        if not isinstance(name, str) or name not in SHAPES:
            unknown = f" = {format_value(name)}: unknown shape{suggest(str(name), list(SHAPES))}"
            raise SpecError([(("shape",), unknown)])
        return cls(build_spec(SHAPES[name], keys)) if table else cls()

    @cached_property
    def _leds(self) -> Leds:
        place, cluster_ids = self.shape.place_leds()
        place.flags.writeable = cluster_ids.flags.writeable = False
        return place, cluster_ids

    def to_table(self) -> dict[str, Any]:
        """The layout as a link's table `[bar]`, with every default."""
        name = next(name for name, shape in SHAPES.items() if isinstance(self.shape, shape))
        return ({} if name == "grid" else {"shape": name}) | asdict(self.shape)

    @cached_property
    def clusters(self) -> int:
        """Number of clusters K."""
        return int(self._leds[1].max()) + 1

    @property
    def length_m(self) -> float:
        """From the upper edge of the topmost LED to the lower edge of the lowest, m."""
        if isinstance(self.shape, LedGrid | LedColumns):
            return self.shape.rows * self.shape.led_pitch_m
        return float(np.ptp(self._leds[0][:, 1])) + self.shape.led_m

    @property
    def width_m(self) -> float:
        """From the left edge of the leftmost LED to the right edge of the rightmost, m."""
        return float(np.ptp(self._leds[0][:, 0])) + self.shape.led_m

    def led_positions_m(self) -> Floats:
        """LED centres (x right, y down, z towards the viewer) from the bar's centre, m, float64 (n, 3)."""
        return self._leds[0]

    def led_clusters(self) -> NDArray[np.int64]:
        """Cluster of each LED, int64 (n,)."""
        return self._leds[1]

    def cluster_positions_m(self) -> Floats:
        """Cluster centres (x right, y down, z towards the viewer), m, float64 (K, 3)."""
        place, cluster_ids = self._leds
        count = np.bincount(cluster_ids)
        return np.stack([np.bincount(cluster_ids, place[:, i]) / count for i in range(3)], -1)

    def cluster_centres_m(self) -> Floats:
        """Cluster centres (x right, y down) as seen from the front, m, float64 (K, 2)."""
        return self.cluster_positions_m()[:, :2]

    @property
    def has_distinct_centres(self) -> bool:
        """Whether the clusters' centres, as seen from the front, are not all at one place.

        >>> ring = [(0.1, 0.0, 0.0, 1), (-0.1, 0.0, 0.0, 1)]
        >>> BarLayout(LedTable(((0.0, 0.0, 0.0, 0), *ring))).has_distinct_centres
        False
        """
        return bool(np.ptp(self.cluster_centres_m(), axis=0).max() > _SAME_M)

    @cached_property
    def has_equal_clusters(self) -> bool:
        """Whether all clusters have the same LEDs about their centres, to the micrometre."""
        place, cluster_ids = self._leds
        offset = np.round((place - self.cluster_positions_m()[cluster_ids]) * 1e6)
        count = np.bincount(cluster_ids)
        if (count != count[0]).any():
            return False
        order = np.lexsort((*offset.T, cluster_ids))
        forms = offset[order].reshape(len(count), count[0], 3)
        return bool((np.abs(forms - forms[0]) <= 1).all())

    @cached_property
    def lit_sides(self) -> NDArray[np.int64]:
        """Sides on which each cluster has a lit neighbour, int64 (K,).

        The sum of 1 above, 2 below, 4 on the left and 8 on the right. On the other sides a cluster appears
        larger than it is, as no neighbour's light shares the blurred pixels. A neighbour may be three LEDs'
        widths away: some pixels of a bar 50 m away, which blur fills.

        >>> bar, panel = LedGrid(18), LedGrid(3, 2, cluster_rows=1)
        >>> BarLayout(bar).lit_sides.tolist(), BarLayout(panel).lit_sides.tolist()
        ([2, 3, 1], [10, 6, 11, 7, 9, 5])
        """
        place, cluster_ids = self._leds
        centres = self.cluster_centres_m()
        size = np.array([np.ptp(place[cluster_ids == k, :2], axis=0) for k in range(self.clusters)])
        most_m = (1 + _MAX_GAP_LEDS) * self.shape.led_m
        sides = np.zeros(self.clusters, np.int64)
        offset = centres[None] - centres[:, None]
        for axis, (before, after) in ((1, (1, 2)), (0, (4, 8))):
            along, across = offset[..., axis], offset[..., 1 - axis]
            gap = np.abs(along) - (size[:, None, axis] + size[None, :, axis]) / 2
            touches = (np.abs(across) <= _SAME_M) & (np.abs(along) > _SAME_M) & (gap <= most_m)
            sides += before * (touches & (along < 0)).any(1)
            sides += after * (touches & (along > 0)).any(1)
        return sides

    @cached_property
    def has_usual_sides(self) -> NDArray[np.bool_]:
        """Which clusters have lit neighbours on the most common sides, bool (K,), so that all appear equal.

        >>> BarLayout(LedGrid(24)).has_usual_sides.tolist()
        [False, True, True, False]
        """
        return np.asarray(self.lit_sides == np.bincount(self.lit_sides).argmax())

    @property
    def is_even_line(self) -> bool:
        """Whether the clusters stand in one straight line, in order and evenly; one cluster does."""
        steps = np.diff(self.cluster_positions_m(), axis=0)
        return len(steps) == 0 or bool(np.abs(steps - steps[0]).max() <= 1e-6 * np.abs(steps[0]).max())

    @property
    def column_pitch_m(self) -> float:
        """Spacing of equal clusters in one even column, the first at its top, m; NaN for another layout.

        >>> round(BarLayout().column_pitch_m, 9)
        0.06
        """
        return self._pitch_m(np.arange(self.clusters)) if self.has_equal_clusters else math.nan

    @cached_property
    def even_columns(self) -> tuple[tuple[NDArray[np.int64], float], ...]:
        """Columns of three evenly spaced clusters or more: their clusters from the top, and pitch, m.

        Empty unless all clusters are equal.

        >>> [(ids.tolist(), round(m, 9)) for ids, m in BarLayout(LedGrid(12, 2, 0.01, 3)).even_columns]
        [([0, 2, 4, 6], 0.03), ([1, 3, 5, 7], 0.03)]
        """
        if not self.has_equal_clusters:
            return ()
        across = np.round(self.cluster_positions_m()[:, [0, 2]] / _SAME_M)
        columns: dict[tuple[float, ...], list[int]] = {}
        for k in np.argsort(self.cluster_positions_m()[:, 1], kind="stable").tolist():
            columns.setdefault(tuple(across[k]), []).append(k)
        by_place = (np.array(columns[place], np.int64) for place in sorted(columns))
        pitches = ((ids, self._pitch_m(ids)) for ids in by_place if len(ids) >= 3)
        return tuple((ids, pitch_m) for ids, pitch_m in pitches if pitch_m > 0)

    def _pitch_m(self, clusters: NDArray[np.int64]) -> float:
        """Spacing of clusters that are evenly one below another, m; NaN for others."""
        steps = np.diff(self.cluster_positions_m()[clusters], axis=0)
        if len(steps) == 0 or np.abs(steps[:, [0, 2]]).max() > _SAME_M:
            return math.nan
        even = steps[:, 1].min() > 0 and np.ptp(steps[:, 1]) < 1e-6 * steps[0, 1]
        return float(steps[0, 1]) if even else math.nan


def read_leds(path: Path | str) -> list[list[float | int]]:
    """Rows [x, y, z, cluster] of a CSV file with the columns x_m, y_m, cluster and optionally z_m.

    Raises:
        InputError: The file cannot be read, or is not CSV.
        ConfigError: A column is missing, a value is out of range, or there are more than 65536 LEDs.
    """
    limits = (-_MAX_M, _MAX_M)
    needed = {"x_m": limits, "y_m": limits, "cluster": (0, _MAX_LEDS - 1)}
    lines, table = read_table(path, needed, {"z_m": limits})
    if len(lines) > _MAX_LEDS:
        raise ConfigError(f"{path}: line {lines[_MAX_LEDS]}: expected at most {_MAX_LEDS} LEDs")
    for line, cluster in zip(lines, table["cluster"].tolist(), strict=True):
        if cluster != int(cluster):
            raise ConfigError(f"{path}: line {line}: cluster = {cluster:g}: expected a whole number")
    x, y, cluster = table["x_m"], table["y_m"], table["cluster"].astype(int)
    z = table.get("z_m", np.zeros(len(x)))
    return [list(row) for row in zip(x.tolist(), y.tolist(), z.tolist(), cluster.tolist(), strict=True)]


def _check_count(leds: int, problem: str) -> None:
    if not 0 < leds <= _MAX_LEDS:
        least = "" if leds else ", and one at least"
        raise ConfigError(f"{problem}: expected at most {_MAX_LEDS} LEDs{least}")


def _check_divisor(name: str, block: int, of: str, n: int) -> None:
    if n % block:
        raise ConfigError(f"bar.{name} = {block}: expected a divisor of bar.{of} = {n}")
