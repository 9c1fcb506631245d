"""The truth of a recording: what each bar sent, with which link, and where it was in the image."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from evlcp_sdk.errors import ConfigError, EvlcpError, InputError
from evlcp_sdk.files import read_json
from evlcp_sdk.link.resolve import Link, resolve
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.scene.sites import BarSite, resolve_sites
from evlcp_sdk.specs import SpecError, validate_table

Floats = NDArray[np.float64]

_DARK_W_M2 = 1e-6
"""Most light of a dark bar."""

_MAX_VALUE = 1e18
"""Largest number in a truth: microseconds since 1970 are 1e15."""

_MAX_PPM = 1e5


@dataclass(frozen=True, eq=False)
class SentBar:
    """The symbols of a bar, its link, and its place over time.

    Attributes:
        link: The link that it was sent with.
        symbols: Symbols, int64 (packets, frames, clusters); packet 0 is on air as the scene starts. A bar
            that sends chips of a file has no packets.
        start_chip: Chip of packet 0 that is on air as the scene starts.
        ppm: How much faster than nominal its clock runs.
        payload: "symbols", "data" or "messages".
        sends_frames: Whether it is lit and sends packets.
        lit: Whether it is lit.
        centre_px: Column and row of its centre at `Truth.t_us`, float64 (n, 2).
        distance_m: Depth of its centre along the optical axis, m, float64 (n,).
        covered: Clusters that are always hidden.
        cover_s: Clusters hidden for a time: (from s, to s, first cluster, last cluster).
        pole_s: Times when all of it is hidden: (from s, to s).
    """

    link: Link
    symbols: NDArray[np.int64]
    start_chip: float
    ppm: float
    payload: str
    sends_frames: bool
    lit: bool
    centre_px: Floats
    distance_m: Floats
    covered: tuple[int, ...] = ()
    cover_s: tuple[tuple[float, float, int, int], ...] = ()
    pole_s: tuple[tuple[float, float], ...] = ()

    @property
    def rate_hz(self) -> float:
        """Chips a second by the clock of the recording."""
        return self.link.air.chip_rate_hz * (1 + self.ppm * 1e-6)


@dataclass(frozen=True, eq=False)
class Truth:
    """The truth of a recording.

    Attributes:
        t0_us: Camera clock as the scene starts, us.
        duration_us: Length of the scene, us.
        t_us: Times of the samples, from the scene's start, us, float64 (n,).
        bars: Truth of each bar.
        sites: Sites of the bars on earth; none without a `[world]`.
        camera_path: Arrays of the camera at `t_us`: latitude_deg, longitude_deg, height_m, heading_deg,
            pitch_deg, roll_deg, float64 (n,), in a scene on earth; position_m and attitude_deg, float64
            (3, n), in the scene's axes. Empty if the file has none.
        table: The JSON values of `REC.truth.json`, with scene, simulator and counts, too.
        warnings: Differences from this installation, in words.
    """

    t0_us: int
    duration_us: float
    t_us: Floats
    bars: tuple[SentBar, ...]
    sites: tuple[BarSite, ...]
    camera_path: Mapping[str, Floats]
    table: Mapping[str, Any]
    warnings: tuple[str, ...] = ()


def truth_path(url: Path | str) -> Path:
    """Return the path of a recording's truth: `night.raw` and `night.csv.gz` have `night.truth.json`."""
    path = Path(url)
    stem = path.name.removesuffix(".gz").rsplit(".", 1)[0] or path.name
    return path.with_name(f"{stem}.truth.json")


def read_truth(path: Path | str, registry: Registry | None = None) -> Truth:
    """Read the truth of a recording from its `REC.truth.json`.

    Raises:
        InputError: It cannot be read, is not a scene's truth, or has other codes than this installation; one
            line.
    """
    return truth_from_table(read_json(path), registry, source=str(path))


def truth_from_table(
    table: Mapping[str, Any],
    registry: Registry | None = None,
    *,
    source: str = "truth",
    links: Mapping[str, Link] | None = None,
) -> Truth:
    """Parse the JSON values of `REC.truth.json`, called `source` in error messages.

    Bars of another generator without a link are taken to use the default link, but for their `profile`,
    `clusters`, `frames` and `pilot_every`. `links` are links by digest, instead of those of the table.

    Raises:
        InputError: It is not a scene's truth, or has other codes than this installation.
    """
    try:
        found = validate_table(_TruthTable, table)
    except SpecError as refused:
        raise InputError(f"{source}: not a scene's truth: {str(refused).splitlines()[0]}") from refused
    t_us, n = np.array(found.t_s) * 1e6, len(found.t_s)
    if not n or (np.diff(t_us) <= 0).any():
        raise _make_error(source, "t_s", found.t_s, "rising times, one at the least")
    for key, lists in (("distance_m", found.distance_m), ("bar_centre_px", found.bar_centre_px)):
        if len(lists) < len(found.bars):
            raise _make_error(source, key, lists, f"one list a bar, {len(found.bars)}")
    warnings: list[str] = []
    if links is None:
        links = _resolve_links(found, registry, source, warnings)
    bars = []
    for i, row in enumerate(found.bars):
        where, (columns, rows), depths = f"bars.{i}", found.bar_centre_px[i], found.distance_m[i]
        for key, values in (("bar_centre_px", columns), ("bar_centre_px", rows), ("distance_m", depths)):
            if len(values) != n:
                raise _make_error(source, f"{key}.{i}", values, f"{n} numbers, one a time of t_s")
        if row.link is None and not links:
            link = _resolve_link(_make_link_table(row, where, source), registry, where, source)
        elif (row.link or "") in links:
            link = links[row.link or ""]
        else:
            raise _make_error(source, f"{where}.link", row.link, "the digest of one of the links")
        bars.append(_parse_bar(row, where, source, link, np.array([columns, rows]).T, np.array(depths)))
    try:
        path = {key: np.array(values) for key, values in found.camera_path.items()}
    except ValueError as fault:
        raise _make_error(source, "camera_path", found.camera_path, "lists of one length") from fault
    return Truth(
        t0_us=int(found.scene.t0_us),
        duration_us=found.scene.duration_s * 1e6,
        t_us=t_us,
        bars=tuple(bars),
        sites=_parse_sites(found, source),
        camera_path=path,
        table=table,
        warnings=tuple(warnings),
    )


_Number = Annotated[float, Field(ge=-_MAX_VALUE, le=_MAX_VALUE)]
_Count = Annotated[int, Field(ge=1, le=2**32)]
_Cluster = Annotated[int, Field(ge=0, le=2**32)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False)


class _SceneTable(_Table):
    t0_us: _Number
    duration_s: Annotated[float, Field(ge=0, le=_MAX_VALUE)]


class _BarTable(_Table):
    """A bar with its link; or, in a file of another generator, with its profile, clusters and frames."""

    symbols: list[list[list[_Cluster]]]
    start_chip: Annotated[float, Field(ge=0, le=_MAX_VALUE)]
    ppm: Annotated[float, Field(ge=-_MAX_PPM, le=_MAX_PPM)]
    payload: Literal["symbols", "data", "messages"] | None = None
    led_w_m2: _Number | None = None
    chips_file: str | None = None
    covered: list[_Cluster] | None = None
    cover_s: list[tuple[_Number, _Number, _Cluster, _Cluster]] | None = None
    pole_s: list[tuple[_Number, _Number]] | None = None
    link: str | None = None
    profile: str | None = None
    clusters: _Count = 16
    frames: _Count | None = None
    pilot_every: _Count = 1
    length_m: _Number | None = None


class _LinkTable(_Table):
    table: dict[str, Any]
    codebook: str
    revisions: dict[str, Any] = {}


class _TruthTable(_Table):
    scene: _SceneTable
    bars: list[_BarTable]
    t_s: list[_Number]
    distance_m: list[list[_Number]]
    bar_centre_px: list[tuple[list[_Number], list[_Number]]]
    links: dict[str, _LinkTable] | None = None
    sites: list[Any] | None = None
    camera_path: dict[str, list[_Number] | list[list[_Number]]] = {}


def _make_error(source: str, where: str, value: Any, wanted: str) -> InputError:
    return InputError(f"{source}: not a scene's truth: {where} = {value!r:.40}: expected {wanted}")


def _parse_bar(
    row: _BarTable, where: str, source: str, link: Link, centre_px: Floats, distance_m: Floats
) -> SentBar:
    covered, cover_s = row.covered or [], row.cover_s or []
    clusters, frames, top = link.codebook.clusters, link.packet.frames, len(link.codebook.codewords) - 1
    for key, numbers in (("covered", covered), ("cover_s", [k for *_, a, b in cover_s for k in (a, b)])):
        if max(numbers, default=0) >= clusters:
            raise _make_error(source, f"{where}.{key}", getattr(row, key), f"clusters 0 to {clusters - 1}")
    wanted = f"packets of {frames} frames of {clusters} symbols, 0 to {top}"
    if {len(packet) for packet in row.symbols} - {frames} or {
        len(frame) for packet in row.symbols for frame in packet
    } - {clusters}:
        raise _make_error(source, f"{where}.symbols", row.symbols, wanted)
    symbols = np.array(row.symbols, np.int64).reshape(-1, frames, clusters)
    for q, f, k in np.argwhere(symbols > top)[:1].tolist():
        raise _make_error(source, f"{where}.symbols.{q}.{f}.{k}", int(symbols[q, f, k]), f"0 to {top}")
    lit = row.led_w_m2 is None or row.led_w_m2 > _DARK_W_M2
    return SentBar(
        link=link,
        symbols=symbols,
        start_chip=row.start_chip,
        ppm=row.ppm,
        payload=row.payload or "symbols",
        sends_frames=lit and row.chips_file is None,
        lit=lit,
        centre_px=centre_px,
        distance_m=distance_m,
        covered=tuple(covered),
        cover_s=tuple(cover_s),
        pole_s=tuple(row.pole_s or ()),
    )


def _resolve_links(
    truth: _TruthTable, registry: Registry | None, source: str, warnings: list[str]
) -> dict[str, Link]:
    """Return the links of a truth by digest; another digest of the same codes here is a warning."""
    found = {}
    for digest, entry in (truth.links or {}).items():
        where = f"links.{digest[:12]}"
        link = _resolve_link(entry.table, registry, where, source)
        differences = [
            f"{role} {link.table[role]['id']} {entry.revisions.get(role)} there, {here} here"
            for role, here in link.revisions.items()
            if entry.revisions.get(role) != here
        ]
        revisions = f" (revisions: {'; '.join(differences)})" if differences else ""
        if link.codebook.digest != entry.codebook:
            raise InputError(
                f"{source}: {where}.codebook = {entry.codebook[:12]}: its settings give"
                f" {link.codebook.digest[:12]} here{revisions}; install the versions it was sent with"
            )
        if link.digest != digest:
            warnings.append(
                f"{source}: {where}: resolves to {link.digest[:12]} here{revisions}; the codes are the same"
            )
        found[digest] = link
    return found


def _resolve_link(table: Mapping[str, Any], registry: Registry | None, where: str, source: str) -> Link:
    try:
        return resolve(table, registry)
    except EvlcpError as refused:
        first = str(refused).splitlines()[0]
        raise InputError(f"{source}: {where}: not a link here: {first}") from refused


def _parse_sites(truth: _TruthTable, source: str) -> tuple[BarSite, ...]:
    if not truth.sites:
        return ()
    try:
        return resolve_sites({"bar": truth.sites}, source=f"{source}: not a scene's truth: sites")
    except ConfigError as refused:
        raise InputError(str(refused).splitlines()[0]) from refused


_LEDS_PER_CLUSTER = 6


def _make_link_table(row: _BarTable, where: str, source: str) -> dict[str, Any]:
    """Return the table of the link of a bar that states its profile, clusters and frames instead."""
    for key, value in (("profile", row.profile), ("frames", row.frames)):
        if value is None:
            raise InputError(f"{source}: {where}.{key}: missing; expected it, or a link")
    leds = _LEDS_PER_CLUSTER * row.clusters
    bar: dict[str, Any] = {"rows": leds, "cluster_rows": _LEDS_PER_CLUSTER}
    if row.length_m is not None:
        bar["led_pitch_m"] = round(row.length_m / leds, 9)
    return {
        "modulation": {"id": row.profile},
        "bar": bar,
        "air": {"frames_per_packet": row.frames, "pilot_every": row.pilot_every},
    }
