"""The truth beside a recording: what each bar sent, with which link, and where it was in the image."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.errors import ConfigError, EvlcpError, InputError
from evlcp_sdk.files import read_json
from evlcp_sdk.link.resolve import Link, resolve
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.scene.sites import BarSite, resolve_sites

Floats = NDArray[np.float64]

_DARK_W_M2 = 1e-6
"""Light up to which a bar counts as dark."""

_PAYLOADS = ("symbols", "data", "messages")

_MOST = 1e18
"""Size of the largest number that a truth holds: microseconds since 1970 are 1e15."""

_MOST_PPM = 1e5


@dataclass(frozen=True, eq=False)
class SentBar:
    """What one bar sent, and where it was.

    Attributes:
        link: The link that it was sent with.
        symbols: int64 (packets, frames, clusters); packet 0 is on air as the scene starts. None of them,
            (0, frames, clusters), where the bar sends chips of a file.
        start_chip: Chip of packet 0 that is on air as the scene starts.
        ppm: How much faster than nominal its clock runs.
        payload: "symbols", "data" or "messages".
        sends_frames: It is lit, and sends packets.
        lit: It is lit.
        centre_px: Column and row of its centre at `Truth.t_us`, float64 (n, 2).
        distance_m: Depth of its centre along the optical axis, m, float64 (n,).
        covered: Clusters that are hidden all the time.
        cover_s: Times and clusters that are hidden then: (from s, to s, first cluster, last cluster).
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

    @property
    def packet(self) -> PacketFormat:
        """Lengths of a packet's parts."""
        return self.link.packet

    @property
    def clusters(self) -> int:
        """Number of clusters K."""
        return self.link.codebook.clusters

    @property
    def bits_per_symbol(self) -> int:
        """Bits that one symbol carries."""
        return self.link.codebook.bits_per_symbol


@dataclass(frozen=True, eq=False)
class Truth:
    """What a recording shows.

    Attributes:
        t0_us: Camera clock as the scene starts, us.
        duration_us: Length of the scene, us.
        t_us: Times of the samples, from the scene's start, us, float64 (n,).
        bars: What each bar sent, and where it was.
        sites: Where the bars stand on earth; none without a `[world]`.
        camera_path: Arrays of the camera at `t_us`: latitude_deg, longitude_deg, height_m, heading_deg,
            pitch_deg, roll_deg, float64 (n,), in a scene on earth; position_m and attitude_deg, float64
            (3, n), in the scene's own axes. Empty where the file says none.
        table: The rest of the JSON: scene, camera, simulator, counts, and under `bars` the rest of each bar.
        warnings: What does not fit this installation, in words.
    """

    t0_us: int
    duration_us: float
    t_us: Floats
    bars: tuple[SentBar, ...]
    sites: tuple[BarSite, ...]
    camera_path: Mapping[str, Floats]
    table: Mapping[str, Any]
    warnings: tuple[str, ...] = ()

    def to_table(self) -> dict[str, Any]:
        """What `REC.truth.json` holds, as JSON values; `truth_from_table` takes it back.

        A bar's `profile`, `clusters`, `frames`, `pilot_every` and `packet_chips` are there for other readers;
        what counts is its `link`, the digest of one of the `links`.
        """
        links = {bar.link.digest: bar.link for bar in self.bars}
        found = dict(self.table)
        found["scene"] = {**found.get("scene", {}), "t0_us": self.t0_us}
        found["scene"].setdefault("duration_s", self.duration_us / 1e6)
        rest = found.get("bars", ({},) * len(self.bars))
        found["bars"] = [{**_table_of(bar), **more} for bar, more in zip(self.bars, rest, strict=True)]
        found["links"] = {
            digest: {
                "table": {section: dict(keys) for section, keys in link.table.items()},
                "codebook": link.codebook.digest,
                "revisions": dict(link.revisions),
            }
            for digest, link in links.items()
        }
        found["t_s"] = [round(t / 1e6, 9) for t in self.t_us.tolist()]
        found["distance_m"] = [bar.distance_m.tolist() for bar in self.bars]
        found["bar_centre_px"] = [bar.centre_px.T.tolist() for bar in self.bars]
        if self.sites:
            found["sites"] = [asdict(site) for site in self.sites]
        if self.camera_path:
            found["camera_path"] = {key: values.tolist() for key, values in self.camera_path.items()}
        return found


def truth_path(url: Path | str) -> Path:
    """Where the truth of a recording lies: `night.raw` and `night.csv.gz` have `night.truth.json`."""
    path = Path(url)
    stem = path.name.removesuffix(".gz").rsplit(".", 1)[0] or path.name
    return path.with_name(f"{stem}.truth.json")


def read_truth(path: Path | str, registry: Registry | None = None) -> Truth:
    """The truth of a recording, from its `REC.truth.json`.

    Args:
        path: The file.
        registry: Where the algorithms of its links are found; None for all that are installed.

    Raises:
        InputError: It cannot be read, is not a scene's truth, or names codes that are not those of this
            installation; one line.
    """
    return truth_from_table(read_json(path), registry, source=str(path))


def truth_from_table(
    table: Mapping[str, Any],
    registry: Registry | None = None,
    *,
    source: str = "truth",
    links: Mapping[str, Link] | None = None,
) -> Truth:
    """The truth of what `REC.truth.json` holds.

    A file of another generator that names no link is read as sent with the default link, but for the
    `profile`, `clusters`, `frames` and `pilot_every` of its bars.

    Args:
        table: The JSON values.
        registry: Where the algorithms of its links are found; None for all that are installed.
        source: What faults name as their place.
        links: Links by digest, instead of those of the table.

    Raises:
        InputError: It is not a scene's truth, or names codes that are not those of this installation.
    """
    return _Reader(source, registry).truth(table, links)


_OWN = ("link", "symbols", "start_chip", "ppm", "payload", "covered", "cover_s", "pole_s")
"""Keys of a bar's table that `SentBar` holds, and those that follow from its link."""

_OF_LINK = ("profile", "clusters", "frames", "pilot_every", "packet_chips")


def _table_of(bar: SentBar) -> dict[str, Any]:
    form = bar.link.packet
    return {
        "link": bar.link.digest,
        "profile": bar.link.codebook.profile,
        "clusters": bar.clusters,
        "frames": form.frames,
        "pilot_every": form.pilot_every,
        "packet_chips": form.packet_chips,
        "ppm": bar.ppm,
        "start_chip": bar.start_chip,
        "payload": bar.payload,
        "symbols": bar.symbols.tolist(),
        "led_w_m2": None if bar.lit else 0.0,
        "chips_file": None,
        **({"covered": list(bar.covered)} if bar.covered else {}),
        **({"cover_s": [list(span) for span in bar.cover_s]} if bar.cover_s else {}),
        **({"pole_s": [list(span) for span in bar.pole_s]} if bar.pole_s else {}),
    }


class _Reader:
    """Checks the values of a truth; every fault names its place."""

    def __init__(self, source: str, registry: Registry | None) -> None:
        self._source = source
        self._registry = registry
        self._warnings: list[str] = []

    def truth(self, table: Any, links: Mapping[str, Link] | None = None) -> Truth:
        wanted = ("bar_centre_px", "bars", "distance_m", "scene", "t_s")
        missing = [key for key in wanted if not isinstance(table, Mapping) or key not in table]
        if missing:
            raise InputError(f"{self._source}: not a scene's truth: {', '.join(missing)} missing")
        scene, rows = self._table(table["scene"], "scene"), self._list(table["bars"], "bars")
        t_us = self._numbers(table["t_s"], "t_s", 1) * 1e6
        n = len(t_us)
        if not n or (np.diff(t_us) <= 0).any():
            raise self._fault("t_s", table["t_s"], "rising times, one at the least")
        for key in ("distance_m", "bar_centre_px"):
            if len(self._list(table[key], key)) < len(rows):
                raise self._fault(key, table[key], f"one list a bar, {len(rows)}")
        if links is None:
            links = self._links(self._table(table.get("links") or {}, "links"))
        bars = []
        for i, row in enumerate(rows):
            depth = self._numbers(table["distance_m"][i], f"distance_m.{i}", 1, n)
            centre = self._numbers(table["bar_centre_px"][i], f"bar_centre_px.{i}", 2, 2, n).T
            bars.append(self._bar(self._table(row, f"bars.{i}"), f"bars.{i}", links, centre, depth))
        path = self._table(table.get("camera_path", {}), "camera_path")
        rest = {
            key: value
            for key, value in table.items()
            if key not in (*wanted, "links", "sites", "camera_path") or key == "scene"
        }
        rest["bars"] = tuple(
            {
                key: value
                for key, value in row.items()
                if key not in _OWN and (key not in _OF_LINK or row.get("chips_file") is not None)
            }
            for row in rows
        )
        return Truth(
            t0_us=int(self._number(scene, "t0_us", "scene.")),
            duration_us=self._number(scene, "duration_s", "scene.", least=0.0) * 1e6,
            t_us=t_us,
            bars=tuple(bars),
            sites=self._sites(table.get("sites", [])),
            camera_path={
                key: self._numbers(values, f"camera_path.{key}", None) for key, values in path.items()
            },
            table=rest,
            warnings=tuple(self._warnings),
        )

    def _bar(
        self, row: Mapping[str, Any], where: str, links: Mapping[str, Link], centre: Floats, depth: Floats
    ) -> SentBar:
        digest = row.get("link")
        if digest is None and not links:
            link = self._resolved(link_table_of(row, self._source, where), where)
        elif isinstance(digest, str) and digest in links:
            link = links[digest]
        else:
            raise self._fault(f"{where}.link", digest, "the digest of one of the links")
        ppm = self._number(row, "ppm", f"{where}.", -_MOST_PPM, _MOST_PPM)
        light = row.get("led_w_m2")
        lit = light is None or self._number(row, "led_w_m2", f"{where}.") > _DARK_W_M2
        clusters = link.codebook.clusters
        payload = row.get("payload") or "symbols"
        if payload not in _PAYLOADS:
            raise self._fault(f"{where}.payload", payload, f"one of {', '.join(_PAYLOADS)}")
        return SentBar(
            link=link,
            symbols=self._symbols(row, where, link),
            start_chip=self._number(row, "start_chip", f"{where}.", least=0.0),
            ppm=ppm,
            payload=payload,
            sends_frames=lit and row.get("chips_file") is None,
            lit=lit,
            centre_px=centre,
            distance_m=depth,
            covered=tuple(self._spans(row, "covered", where, 1, clusters)[:, 0].astype(int).tolist()),
            cover_s=tuple(
                (a, b, int(first), int(last))
                for a, b, first, last in self._spans(row, "cover_s", where, 4, clusters).tolist()
            ),
            pole_s=tuple((a, b) for a, b in self._spans(row, "pole_s", where, 2, clusters).tolist()),
        )

    def _links(self, given: Mapping[str, Any]) -> dict[str, Link]:
        found = {}
        for digest, value in given.items():
            where = f"links.{digest[:12]}"
            entry = self._table(value, where)
            table = self._table(entry.get("table"), f"{where}.table")
            link = self._resolved(table, where)
            if link.codebook.digest != entry.get("codebook"):
                raise InputError(
                    f"{self._source}: {where}.codebook = {str(entry.get('codebook'))[:12]}: its settings give"
                    f" {link.codebook.digest[:12]} here{self._revisions(entry, link)};"
                    " install the versions it was sent with"
                )
            if link.digest != digest:
                self._warnings.append(
                    f"{self._source}: {where}: resolves to {link.digest[:12]} here"
                    f"{self._revisions(entry, link)}; the codes are the same"
                )
            found[digest] = link
        return found

    def _resolved(self, table: Mapping[str, Any], where: str) -> Link:
        if self._registry is None:
            self._registry = Registry.load()
        try:
            return resolve(table, self._registry)
        except EvlcpError as refused:
            first = str(refused).splitlines()[0]
            raise InputError(f"{self._source}: {where}: not a link here: {first}") from refused

    def _revisions(self, entry: Mapping[str, Any], link: Link) -> str:
        """Which algorithms have another revision here than in the file."""
        given = entry.get("revisions")
        given = given if isinstance(given, Mapping) else {}
        other = [
            f"{role} {link.table[role]['id']} {given.get(role)} there, {here} here"
            for role, here in link.revisions.items()
            if given.get(role) != here
        ]
        return f" (revisions: {'; '.join(other)})" if other else ""

    def _symbols(self, row: Mapping[str, Any], where: str, link: Link) -> NDArray[np.int64]:
        frames, clusters = link.packet.frames, link.codebook.clusters
        if "symbols" not in row:
            raise InputError(f"{self._source}: {where}.symbols: missing")
        given, top = row["symbols"], len(link.codebook.codewords)
        wanted = f"packets of {frames} frames of {clusters} symbols, 0 to {top - 1}"
        if isinstance(given, list) and not given:
            return np.empty((0, frames, clusters), np.int64)
        try:
            symbols = np.array(given)
        except ValueError as fault:
            raise self._fault(f"{where}.symbols", given, wanted) from fault
        if symbols.shape[1:] != (frames, clusters) or symbols.dtype.kind != "i":
            raise self._fault(f"{where}.symbols", given, wanted)
        for q, f, k in np.argwhere((symbols < 0) | (symbols >= top))[:1].tolist():
            raise self._fault(f"{where}.symbols.{q}.{f}.{k}", int(symbols[q, f, k]), f"0 to {top - 1}")
        return symbols.astype(np.int64)

    def _sites(self, given: Any) -> tuple[BarSite, ...]:
        if not self._list(given, "sites"):
            return ()
        try:
            return resolve_sites({"bar": given}, source=f"{self._source}: not a scene's truth: sites")
        except ConfigError as refused:
            raise InputError(str(refused).splitlines()[0]) from refused

    def _spans(self, row: Mapping[str, Any], key: str, where: str, columns: int, clusters: int) -> Floats:
        given = row.get(key) or []
        rows = [[v] for v in given] if columns == 1 and isinstance(given, list) else given
        found = self._numbers(rows, f"{where}.{key}", None)
        if not found.size:
            return np.empty((0, columns))
        if found.ndim != 2 or found.shape[1] != columns:
            raise self._fault(f"{where}.{key}", given, f"a list of lists of {columns} numbers")
        # Behind the times, or alone, stand numbers of clusters.
        numbers = found[:, 2:] if columns > 1 else found
        if ((numbers < 0) | (numbers >= clusters) | (numbers % 1 != 0)).any():
            raise self._fault(f"{where}.{key}", given, f"clusters 0 to {clusters - 1}")
        return found

    def _table(self, value: Any, where: str) -> Mapping[str, Any]:
        if not isinstance(value, Mapping):
            raise self._fault(where, value, "a table")
        return value

    def _list(self, value: Any, where: str) -> Sequence[Any]:
        if not isinstance(value, list | tuple):
            raise self._fault(where, value, "a list")
        return value

    def _number(
        self,
        table: Mapping[str, Any],
        key: str,
        before: str = "",
        least: float = -_MOST,
        most: float = _MOST,
    ) -> float:
        value = table.get(key)
        wanted = "a number" if least == -_MOST else f"a number, at least {least:g}"
        if key not in table:
            raise InputError(f"{self._source}: {before}{key}: missing; expected {wanted}")
        if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
            wanted += "" if most == _MOST else f" and at most {most:g}"
            raise self._fault(before + key, value, wanted)
        return value

    def _numbers(self, given: Any, where: str, ndim: int | None, *shape: int) -> Floats:
        wanted = f"finite numbers, {' x '.join(map(str, shape))}" if shape else "a list of finite numbers"
        try:
            found = np.array(given, np.float64)
        except (TypeError, ValueError, OverflowError) as fault:
            raise self._fault(where, given, wanted) from fault
        right = ndim is None or (found.ndim == ndim and (not shape or found.shape == shape))
        if not right or not (np.abs(found) <= _MOST).all():
            raise self._fault(where, given, wanted)
        return found

    def _fault(self, where: str, value: Any, wanted: str) -> InputError:
        return InputError(f"{self._source}: not a scene's truth: {where} = {value!r:.40}: expected {wanted}")


_LEDS_PER_CLUSTER = 6


def link_table_of(row: Mapping[str, Any], source: str, where: str) -> dict[str, Any]:
    """The link's table of a bar that says its profile, clusters and frames instead of a link.

    Args:
        row: The bar's table.
        source: What faults name as their file.
        where: What faults name as the bar.

    Raises:
        InputError: A value is missing or not what it should be.
    """
    reader = _Reader(source, None)
    clusters, frames, every = (
        reader._number({"pilot_every": 1, "clusters": 16, **row}, key, f"{where}.", least=1)
        for key in ("clusters", "frames", "pilot_every")
    )
    profile = row.get("profile")
    if not isinstance(profile, str):
        raise InputError(f"{source}: {where}.profile = {profile!r}: expected a modulation's id, or a link")
    leds = _LEDS_PER_CLUSTER * int(clusters)
    bar: dict[str, Any] = {"rows": leds, "cluster_rows": _LEDS_PER_CLUSTER}
    if "length_m" in row:
        bar["led_pitch_m"] = round(reader._number(row, "length_m", f"{where}.") / leds, 9)
    return {
        "modulation": {"id": profile},
        "bar": bar,
        "air": {"frames_per_packet": frames, "pilot_every": every},
    }
