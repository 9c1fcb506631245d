"""Geodetic positions of transmitters: `site.toml`, and the local axes in which positions are computed.

Heights are above the WGS-84 ellipsoid. Local axes point east, north and up (ENU) at an origin near the bars.
See `docs/position.md`.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from evlcp_sdk.errors import ConfigError, name_place
from evlcp_sdk.formatting import suggest, to_toml_value
from evlcp_sdk.lazy import LazyModule
from evlcp_sdk.scene.bar import BarLayout
from evlcp_sdk.specs import build_spec, read_toml

pymap3d: Any = LazyModule("pymap3d")

_MIN_UPRIGHT = 0.1
"""Sine of a bar axis' elevation below which the bar counts as lying, so that its LEDs face horizontally."""

_MIN_FACING = 0.01
"""Sine of the angle between a bar's axis and its facing, below which the facing is undetermined."""


@dataclass(frozen=True)
class BarSite:
    """Position and attitude of one bar: a `[[bar]]` of `site.toml`, and the content of its beacon.

    Its axis points from its bottom to its top, where its first cluster is: up, tilted towards `heading_deg`.

    >>> BarSite(7, 35.0, 137.0, 50.0, tilt_deg=90.0, heading_deg=90.0).axis_enu().round(6).tolist()
    [1.0, 0.0, 0.0]
    """

    transmitter_id: Annotated[int, Field(ge=0, lt=2**32, description="Transmitter id, as in its beacon.")]
    latitude_deg: Annotated[float, Field(ge=-90, le=90, description="Latitude of the bar's centre, WGS-84.")]
    longitude_deg: Annotated[float, Field(ge=-180, le=180, description="Its longitude.")]
    height_m: Annotated[
        float, Field(ge=-12_000, le=20_000, description="Its height above the WGS-84 ellipsoid.")
    ]
    heading_deg: Annotated[
        float, Field(ge=0, lt=360, description="Direction to which its top tilts, clockwise from north.")
    ] = 0.0
    tilt_deg: Annotated[
        float,
        Field(ge=0, le=180, description="Tilt of its axis from the vertical; 90: lying, 180: upside down."),
    ] = 0.0
    length_m: Annotated[
        float,
        Field(
            gt=0,
            le=100,
            description="Between its outermost LEDs' edges; of clusters not in line, its height.",
        ),
    ] = 0.96
    transmitter: Annotated[
        int | None,
        Field(ge=0, description="Number from the receiver, if no beacon sends its id."),
    ] = None
    link: Annotated[
        str | None,
        Field(description="Name of its link, if there are several; none: any."),
    ] = None
    position_sigma_m: Annotated[
        float | None,
        Field(ge=0, le=1000, description="Sigma of its position to the east, north and up; none: exact."),
    ] = None
    attitude_sigma_deg: Annotated[
        float, Field(ge=0, le=180, description="Sigma of its rotation about each axis; 0: exact.")
    ] = 0.0
    length_sigma_m: Annotated[float, Field(ge=0, le=10, description="Sigma of its length; 0: exact.")] = 0.0
    facing_deg: Annotated[
        float | None,
        Field(
            ge=0,
            lt=360,
            description="Direction of its light, clockwise from north; for clusters not in line.",
        ),
    ] = None

    @property
    def survey_sigmas(self) -> tuple[float, float, float]:
        """Sigmas of position, m, of rotation about each axis, radians, and of length, as a share of it."""
        rotation_rad = math.radians(self.attitude_sigma_deg)
        return self.position_sigma_m or 0.0, rotation_rad, self.length_sigma_m / self.length_m

    def axis_enu(self) -> NDArray[np.float64]:
        """Unit vector from its bottom to its top, in east, north and up at its own centre, float64 (3,)."""
        heading, tilt = math.radians(self.heading_deg), math.radians(self.tilt_deg)
        level = math.sin(tilt)
        return np.array([level * math.sin(heading), level * math.cos(heading), math.cos(tilt)])

    def cluster_positions_m(self, clusters: int, axes: "LocalAxes") -> NDArray[np.float64]:
        """Centres of the equal parts of the bar in local axes, from its top, m, float64 (clusters, 3)."""
        along = (0.5 - (np.arange(clusters) + 0.5) / clusters) * self.length_m
        return self._to_local_axes(along[:, None] * self.axis_enu(), axes)

    def layout_positions_m(self, bar: BarLayout, axes: "LocalAxes") -> NDArray[np.float64]:
        """Centres of the clusters of a layout in local axes, m, float64 (K, 3).

        Clusters evenly in line are along the axis, from its top; others around the centre, as seen from the
        front, scaled to `length_m`.

        Raises:
            ConfigError: The clusters are not in line, and the site lacks `facing_deg`.
        """
        if bar.is_even_line:
            return self.cluster_positions_m(bar.clusters, axes)
        name = f"site of id {self.transmitter_id}"
        if self.facing_deg is None:
            raise ConfigError(f"{name}: facing_deg: missing; expected where the LEDs shine to")
        up, facing = self.axis_enu(), math.radians(self.facing_deg)
        towards = np.array([math.sin(facing), math.cos(facing), 0.0])
        if abs(up[2]) >= _MIN_UPRIGHT:
            # At a right angle to the axis, above or below the facing on the horizon.
            towards[2] = -(towards @ up) / up[2]
        else:
            towards -= (towards @ up) * up
        if np.linalg.norm(towards) < _MIN_FACING:
            raise ConfigError(f"{name}: facing_deg = {self.facing_deg:g}: its axis points there")
        towards /= np.linalg.norm(towards)
        x, y, z = bar.cluster_positions_m().T[:, :, None] * (self.length_m / bar.length_m)
        return self._to_local_axes(x * np.cross(up, towards) - y * up + z * towards, axes)

    def _to_local_axes(self, offset: NDArray[np.float64], axes: "LocalAxes") -> NDArray[np.float64]:
        """Points by their offsets east, north and up from the bar's centre, in local axes, m, (n, 3)."""
        centre = (self.latitude_deg, self.longitude_deg, self.height_m)
        ecef = pymap3d.enu2ecef(*offset.T, *centre)
        return np.stack(pymap3d.ecef2enu(*ecef, *axes.origin), -1)


@dataclass(frozen=True)
class LocalAxes:
    """East, north and up at an origin on earth.

    >>> axes = LocalAxes(35.0, 137.0, 50.0)
    >>> axes.to_enu(*axes.to_geodetic([10.0, 20.0, 3.0])).round(6).tolist()
    [10.0, 20.0, 3.0]
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float

    @classmethod
    def of(cls, sites: Sequence[BarSite]) -> "LocalAxes":
        """The axes at the centre of the first bar.

        Raises:
            ConfigError: There is none.
        """
        if not sites:
            raise ConfigError("local axes need one bar or more")
        first = sites[0]
        return cls(first.latitude_deg, first.longitude_deg, first.height_m)

    @property
    def origin(self) -> tuple[float, float, float]:
        """Latitude, longitude and height of the origin."""
        return self.latitude_deg, self.longitude_deg, self.height_m

    def rotation_from(self, other: "LocalAxes") -> NDArray[np.float64]:
        """Rotation of vectors from other axes into these, float64 (3, 3): 0.009 degrees a kilometre.

        >>> far = LocalAxes(35.1, 137.0, 50.0)
        >>> up = LocalAxes(35.0, 137.0, 50.0).rotation_from(far)[:, 2]
        >>> round(float(np.degrees(np.arctan2(up[1], up[2]))), 3)
        0.1
        """
        return np.asarray(self._ecef_axes() @ other._ecef_axes().T)

    def _ecef_axes(self) -> NDArray[np.float64]:
        """East, north and up in the earth's axes (ECEF), as rows."""
        return np.stack(pymap3d.enu2uvw(*np.eye(3), self.latitude_deg, self.longitude_deg), -1)

    def to_enu(
        self, latitude_deg: ArrayLike, longitude_deg: ArrayLike, height_m: ArrayLike
    ) -> NDArray[np.float64]:
        """Geodetic coordinates (n,) to east, north, up, m, float64 (n, 3); scalars give (3,)."""
        place = [np.asarray(v, np.float64) for v in (latitude_deg, longitude_deg, height_m)]
        return np.stack(pymap3d.geodetic2enu(*place, *self.origin), -1)

    def to_geodetic(self, enu_m: ArrayLike) -> tuple[Any, Any, Any]:
        """East, north, up (n, 3) or (3,) to latitude and longitude, degrees, and height, m, (n,) each."""
        east, north, up = np.moveaxis(np.asarray(enu_m, np.float64), -1, 0)
        latitude, longitude, height = pymap3d.enu2geodetic(east, north, up, *self.origin)
        return latitude, longitude, height


@dataclass(frozen=True)
class _SiteFile:
    bar: tuple[BarSite, ...]


def load_sites(path: Path | str) -> tuple[BarSite, ...]:
    """Read a `site.toml`: one `[[bar]]` or more.

    Raises:
        ConfigError: The file cannot be read, is not TOML, or does not describe bars; one line per fault.
    """
    return resolve_sites(read_toml(path), source=str(path))


def resolve_sites(table: Mapping[str, Any], *, source: str = "") -> tuple[BarSite, ...]:
    """Check a table of bars, with every default.

    Args:
        table: As read from TOML: `bar`, a list of tables.
        source: Name of the file in errors.

    Raises:
        ConfigError: One line per fault, each with its path, e.g. `bar.0.latitude_deg`.

    >>> bar = {"transmitter_id": 1, "latitude_deg": 35.0, "longitude_deg": 137.0, "height_m": 5.0}
    >>> resolve_sites({"bar": [bar]})[0].length_m
    0.96
    """
    prefix = f"{source}: " if source else ""
    rows = table.get("bar")
    if not isinstance(rows, list) or not rows:
        lines = [f"{prefix}{key}: unknown table{suggest(key, ['bar'])}" for key in table if key != "bar"]
        raise ConfigError("\n".join([*lines, f"{prefix}bar: expected one [[bar]] or more"]))
    with name_place(prefix):
        sites = build_spec(_SiteFile, table).bar
    faults = []
    for name in ("transmitter_id", "transmitter"):
        first: dict[int, int] = {}
        for i, site in enumerate(sites):
            number = getattr(site, name)
            if number is not None and first.setdefault(number, i) != i:
                same = f"bar.{first[number]} has it, too; expected one each"
                faults.append(f"{prefix}bar.{i}.{name} = {number}: {same}")
    if faults:
        raise ConfigError("\n".join(faults))
    return sites


def to_toml(sites: Sequence[BarSite]) -> str:
    """Sites as the text of a `site.toml` for `load_sites`."""
    lines = []
    for site in sites:
        values = ((f.name, getattr(site, f.name)) for f in fields(site))
        lines += [
            "[[bar]]",
            *(f"{name} = {to_toml_value(value)}" for name, value in values if value is not None),
            "",
        ]
    return "\n".join(lines)


def site_of_transmitter(
    sites: Sequence[BarSite], transmitter: int, transmitter_id: int | None = None, *, is_only: bool = False
) -> BarSite | None:
    """The site of a received transmitter; None if it is unknown.

    The id in its beacon decides, before the first one a site's `transmitter`. The only transmitter received
    is at the only site.
    """
    if transmitter_id is not None:
        return next((s for s in sites if s.transmitter_id == transmitter_id), None)
    named = next((s for s in sites if s.transmitter == transmitter), None)
    if named is None and is_only and len(sites) == 1 and sites[0].transmitter is None:
        return sites[0]
    return named
