"""The light of bars and lamps: strips whose parts switch at exact times."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.blocks import HEADER_BYTES, Kind, Message
from evlcp_sdk.air.codebook import longest_run
from evlcp_sdk.air.frames import packet_chips
from evlcp_sdk.errors import ConfigError, name_place
from evlcp_sdk.files import read_npy
from evlcp_sdk.link.compose import beacon_of_site, encode_messages
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.scene.sites import BarSite
from evlcp_sdk.sim.leds import LitStrip, split_into_strips
from evlcp_sdk.sim.optics import led_light_w_m2
from evlcp_sdk.sim.scene import (
    MAX_SOURCES,
    BackgroundSpec,
    BarSpec,
    LampSpec,
    LensSpec,
    ReflectionSpec,
    Scene,
    WiperSpec,
    links_of,
)
from evlcp_sdk.sim.world import bar_axes, sites_of

Floats = NDArray[np.float64]

_SINE_STEPS = 32

_WIPER_STEP_LN = 0.05
"""Steps of the light while a wiper's edge passes: a quarter of a threshold, too little for an event."""

_BACKGROUND_STEP_LN = 0.01
"""Steps of the light while the background changes: a twentieth of a threshold keeps the number of events."""

_SLAT_STEP_UM = 1000.0
"""Steps in which a lattice moves along a bar, um: a tenth of an LED's pitch."""


@dataclass(frozen=True, eq=False)
class Source:
    """A straight strip of light, cut into clusters that switch one by one; or a reflection of one.

    Attributes:
        centre_m: Its middle in the scene, x, y, z, float64 (3,).
        along_m: Vector from its first end to its last, float64 (3,).
        width_m: Its width.
        cuts: Where its clusters start and end, shares of its length from -0.5 to 0.5.
        light_w_m2: Irradiance of a pixel that it fills.
        longest_us: How long its full light may move a slow pixel the same way, us.
        switches: Takes two times, us, and returns the times of switching between them, float64 (n,), and the
            levels from 0 to 1 from the first time and from each of these on, float64 (n + 1, clusters).
        image: The reflection that shows it; None for the direct view.
    """

    centre_m: Floats
    along_m: Floats
    width_m: float
    cuts: tuple[float, ...]
    light_w_m2: float
    longest_us: float
    switches: Callable[[float, float], tuple[Floats, Floats]]
    image: ReflectionSpec | None = None

    @property
    def clusters(self) -> int:
        """Number of its clusters."""
        return len(self.cuts) - 1

    def cuts_m(self) -> Floats:
        """Return where its clusters start and end, float64 (clusters + 1, 3)."""
        return self.centre_m + np.array(self.cuts)[:, None] * self.along_m


def cut_changes(when_us: Floats, held: Floats, begin_us: float, end_us: float) -> tuple[Floats, Floats]:
    """Cut changes, and the values held before and after each, to a span of time."""
    first, last = np.searchsorted(when_us, begin_us, "right"), np.searchsorted(when_us, end_us, "left")
    return when_us[first:last], held[first : last + 1]


class BarLight:
    """A transmitter's light: packets, one after another, or the chips of a file.

    Its `strips` are all switched by the same chips; a pixel that the brightest fills has `light_w_m2`. Its
    `images` repeat the strips for each reflection. No LED of its `dark` clusters blinks.

    Args:
        bar: The bar.
        link: The link that it sends with.
        lens: The lens, by which LEDs light a pixel.
        seed: Seed of its payload and start, unless the bar has one.
        source: Name of the bar in error messages.
        transmitter_id: Sender of its messages.
        site: Site in its beacon; None sends none.
        reflections: Its reflections.

    Raises:
        ConfigError: Its symbols, messages or chips cannot be sent, or a cover is of none of its clusters.
        InputError: The file of chips cannot be read.
    """

    def __init__(
        self,
        bar: BarSpec,
        link: Link,
        lens: LensSpec,
        seed: int,
        source: str = "bars",
        transmitter_id: int = 1,
        site: BarSite | None = None,
        reflections: Sequence[ReflectionSpec] = (),
    ) -> None:
        self.bar = bar
        self.link = link
        self.payload_seed = seed if bar.seed is None else bar.seed
        with name_place(f"{source}."):
            strips = split_into_strips(bar, link.bar, self.payload_seed)
        lights = [led_light_w_m2(bar, strip, lens) for strip in strips]
        self.light_w_m2 = max(lights)
        self.centre_m = (bar.x_m, bar.y_m, bar.z_m)
        self.rate_hz = link.air.chip_rate_hz * (1 + bar.ppm * 1e-6)
        # Codes are constant for two chips at most, half their amplitude from their mean.
        self.longest_us = 1e6 / self.rate_hz
        self._chips: NDArray[np.uint8] | None = None
        self._make_packet = lru_cache(64)(
            lambda q: packet_chips(self.symbols(q), link.codebook, link.packet.pilot_every)
        )
        self._transmitter_id = transmitter_id
        for key, payload in (("symbols", "symbols"), ("text", "messages"), ("chips_file", "symbols")):
            if getattr(bar, key) is not None and bar.payload != payload:
                raise ConfigError(f"{source}.payload = {bar.payload!r}: expected {payload!r} beside {key}")
        if bar.chips_file is not None and bar.symbols is not None:
            raise ConfigError(f"{source}.symbols: expected them, or chips_file, not both")
        if bar.chips_file is not None:
            self._chips = _read_chips(Path(bar.chips_file), link.codebook.clusters)
            self.packet_chips = len(self._chips)
            self.longest_us *= max(map(longest_run, self._chips.T))
        else:
            with name_place(f"{source}: "):
                if bar.payload != "symbols":
                    self._coder = link.block_coder()
                if bar.payload == "messages":
                    self._cycle = self._encode_messages(site)
            self.packet_chips = link.packet.packet_chips
            if bar.symbols is not None:
                self._check_symbols(bar, source)
        start = bar.start_chip
        if start is None:
            start = round(
                float(np.random.default_rng([self.payload_seed, 1]).uniform(0, self.packet_chips)), 1
            )
        self.start_chip = start
        self._covers = self._check_covers(source)
        lit = {int(k) for strip in strips for k in strip.clusters[strip.switched > 0]}
        self.dark = set(range(link.codebook.clusters)) - lit
        shares = [light / self.light_w_m2 if self.light_w_m2 else 1.0 for light in lights]
        self.strips = tuple(map(self._make_source, strips, shares))
        self.images = tuple(
            self._make_source(strip, share, one)
            for one in reflections
            for strip, share in zip(strips, shares, strict=True)
        )

    def _make_source(self, lit: LitStrip, share: float, image: ReflectionSpec | None = None) -> Source:
        """Place a strip of the layout in the scene, with its share of the light, or its reflection."""
        axes = bar_axes(self.bar)
        centre_m = np.array(self.centre_m) + np.array(lit.centre_m) @ axes
        along_m = lit.length_m * axes[int(lit.is_vertical)]
        if image is not None:
            share *= image.share
            if image.kind != "window":
                plane_m, axis = self.centre_m[0], 0
                if image.kind == "road":
                    plane_m, axis = max(one.cuts_m()[[0, -1], 1].max() for one in self.strips), 1
                plane_m += 0.5 * image.gap_m
                centre_m[axis], along_m[axis] = 2 * plane_m - centre_m[axis], -along_m[axis]

        def switches(begin_us: float, end_us: float) -> tuple[Floats, Floats]:
            when, levels = self.switches(begin_us, end_us)
            shown = levels[:, lit.clusters] * lit.switched + lit.constant
            return (when, shown) if image else self.hide_clusters(when, shown, begin_us, end_us, lit)

        light_w_m2 = self.light_w_m2 * share
        return Source(centre_m, along_m, lit.width_m, lit.cuts, light_w_m2, self.longest_us, switches, image)

    def _check_covers(self, source: str) -> tuple[tuple[float, float, int, int], ...]:
        """Return what hides clusters for a time: (from us, to us, first cluster, last cluster)."""
        bar, last = self.bar, self.link.codebook.clusters - 1
        if not all(0 <= k <= last for k in bar.covered):
            raise ConfigError(f"{source}.covered = {list(bar.covered)}: expected clusters, 0 to {last}")
        for key, spans in (("cover_s", bar.cover_s), ("pole_s", bar.pole_s)):
            for i, span in enumerate(spans):
                if not 0 <= span[0] < span[1]:
                    raise ConfigError(f"{source}.{key}.{i} = {list(span)}: expected a time, and a later one")
        every_m, wide_m, _ = bar.lattice_m or (math.inf, 1.0, 0.0)
        if min(wide_m, every_m - wide_m) < _SLAT_STEP_UM * 1e-6:
            raise ConfigError(
                f"{source}.lattice_m = {list(bar.lattice_m or ())}: expected [every, width, first], with"
                f" width and every - width {_SLAT_STEP_UM * 1e-6:g} or more"
            )
        if bar.lattice_mps and bar.lattice_m is None:
            raise ConfigError(f"{source}.lattice_mps = {bar.lattice_mps}: expected lattice_m beside it")
        for i, (_, _, a, b) in enumerate(bar.cover_s):
            if not 0 <= a <= b <= last:
                raise ConfigError(
                    f"{source}.cover_s.{i} = {list(bar.cover_s[i])}: expected the first and the last of its"
                    f" clusters, 0 to {last}"
                )
        poles = tuple((a, b, 0, last) for a, b in bar.pole_s)
        return tuple((a * 1e6, b * 1e6, first, end) for a, b, first, end in (*bar.cover_s, *poles))

    def hide_clusters(
        self, when_us: Floats, levels: Floats, begin_us: float, end_us: float, lit: LitStrip
    ) -> tuple[Floats, Floats]:
        """Darken what covers hide in the parts of a strip.

        `when_us` are times of switching between `begin_us` and `end_us`, float64 (n,), `levels` hold from
        `begin_us` and from each of them on, float64 (n + 1, parts). Returns both, with the times at which a
        cover starts or ends.
        """
        slats, speed_mps = self.bar.lattice_m, self.bar.lattice_mps
        if not self._covers and not self.bar.covered and slats is None:
            return when_us, levels
        edges = np.array([t for cover in self._covers for t in cover[:2] if begin_us < t < end_us])
        steps_per_us = abs(speed_mps) / _SLAT_STEP_UM
        if slats is not None and steps_per_us:
            steps = np.arange(math.floor(begin_us * steps_per_us) + 1, math.ceil(end_us * steps_per_us))
            edges = np.append(edges, steps / steps_per_us)
        when = np.sort(np.concatenate([when_us, edges]))
        start = np.append(begin_us, when)
        seen: Floats = levels[np.searchsorted(when_us, start, side="right")]
        seen[:, np.isin(lit.clusters, self.bar.covered)] = 0.0
        for from_us, to_us, first, last in self._covers:
            behind = (lit.clusters >= first) & (lit.clusters <= last)
            seen[np.ix_((start >= from_us) & (start < to_us), behind)] = 0.0
        if slats is not None:
            every_m, width_m, first_m = slats
            # Length that slats hide above each cut, by its place among the slats.
            moved_m = np.floor(start * steps_per_us + 1e-6) * math.copysign(1e-6 * _SLAT_STEP_UM, speed_mps)
            at_m = (np.array(lit.cuts) + 0.5) * lit.length_m - first_m - moved_m[:, None]
            hidden = at_m // every_m * width_m + np.minimum(at_m % every_m, width_m)
            seen *= 1 - np.diff(hidden, axis=1) / np.diff(at_m, axis=1)
        return when, seen

    def _check_symbols(self, bar: BarSpec, source: str) -> None:
        assert bar.symbols is not None
        for q, packet in enumerate(bar.symbols):
            frames = self.link.packet.frames
            if len(packet) != frames:
                raise ConfigError(f"{source}.symbols.{q}: {len(packet)} frames, expected {frames}")
            try:
                packet_chips(np.array(packet, np.int64), self.link.codebook)
            except (ConfigError, ValueError) as refused:
                raise ConfigError(f"{source}.symbols.{q}: {refused}") from refused
        if not bar.symbols:
            raise ConfigError(f"{source}.symbols: expected at least one packet")

    def _encode_messages(self, site: BarSite | None) -> NDArray[np.int64]:
        """Return packets of its beacon and its text in turn, int64 (packets, frames, clusters)."""
        identity, found = self._transmitter_id, []
        if site is not None:
            found.append(Message(Kind.BEACON, identity, 0, beacon_of_site(site).pack()))
        if self.bar.text is not None:
            found.append(Message(Kind.TEXT, identity, 0, self.bar.text.encode()))
        if not found:
            raise ConfigError(
                'payload = "messages": expected a text, or a [world] whose place a beacon can send'
            )
        return encode_messages(found, self._coder)

    def symbols(self, packet: int) -> NDArray[np.int64]:
        """Return the symbols of a packet, counted from that of `start_chip`, int64 (frames, clusters)."""
        if self.bar.symbols is not None:
            return np.array(self.bar.symbols[packet % len(self.bar.symbols)], np.int64)
        if self.bar.payload == "messages":
            return np.asarray(self._cycle[packet % len(self._cycle)])
        rng = np.random.default_rng([self.payload_seed, 2, packet])
        if self.bar.payload == "data":
            part = rng.bytes(self._coder.block_bytes - HEADER_BYTES)
            message = Message(Kind.DATA, self._transmitter_id, packet, part)
            return np.asarray(encode_messages([message], self._coder)[0])
        book = self.link.codebook
        return rng.integers(0, book.data_symbols, (self.link.packet.frames, book.clusters))

    def list_symbols(self, duration_s: float) -> list[list[list[int]]]:
        """Return the symbols [packet][frame][cluster] of every packet that starts in the scene."""
        if self._chips is not None:
            return []
        packets = math.floor((self.start_chip + duration_s * self.rate_hz) / self.packet_chips) + 1
        return [self.symbols(q).tolist() for q in range(packets)]

    def chips(self, first: int, last: int) -> NDArray[np.uint8]:
        """Return chips [first, last) by the transmitter's count, uint8 (n, clusters)."""
        if self._chips is not None:
            return self._chips[np.arange(first, last) % len(self._chips)]
        begin, end = first // self.packet_chips, (last - 1) // self.packet_chips + 1
        rows = np.concatenate([self._make_packet(q) for q in range(begin, end)])
        return rows[first - begin * self.packet_chips : last - begin * self.packet_chips]

    def switches(self, begin_us: float, end_us: float) -> tuple[Floats, Floats]:
        """Return times of switching and levels of all clusters; see `Source`."""
        first = math.floor(self.start_chip + begin_us * 1e-6 * self.rate_hz) - 1
        last = math.ceil(self.start_chip + end_us * 1e-6 * self.rate_hz) + 2
        first = max(first, 0)
        when: Floats = (np.arange(first, last, dtype=np.float64) - self.start_chip) / self.rate_hz * 1e6
        begin, end = np.searchsorted(when, begin_us, "right"), np.searchsorted(when, end_us, "left")
        return when[begin:end], self.chips(first + int(begin) - 1, first + int(end)).astype(np.float64)


def _read_chips(path: Path, clusters: int) -> NDArray[np.uint8]:
    chips = read_npy(path)
    if chips.ndim != 2 or chips.shape[1] != clusters or not len(chips) or not np.isin(chips, (0, 1)).all():
        raise ConfigError(
            f"{path}: {chips.dtype} {chips.shape}, expected 0 and 1 in an array (chips, {clusters} clusters)"
        )
    return chips.astype(np.uint8)


def make_lamp_source(lamp: LampSpec) -> Source:
    """Make the source of a lamp: a square wave, or the square of a sine in steps."""
    if lamp.waveform == "square":
        offsets, values = np.array([0.0, lamp.duty]), np.array([1.0, 0.0])
    else:
        offsets = np.arange(_SINE_STEPS) / _SINE_STEPS
        values = np.sin(math.pi * (offsets + 0.5 / _SINE_STEPS)) ** 2
    levels = 1 - lamp.depth + lamp.depth * values

    def switches(begin_us: float, end_us: float) -> tuple[Floats, Floats]:
        first = math.floor(begin_us * 1e-6 * lamp.flicker_hz + lamp.phase) - 1
        last = math.ceil(end_us * 1e-6 * lamp.flicker_hz + lamp.phase) + 1
        periods = np.arange(first, last)
        when = ((periods[:, None] + offsets - lamp.phase) / lamp.flicker_hz * 1e6).ravel()
        held = np.append(levels[-1], np.tile(levels, len(periods)))
        return cut_changes(when, held[:, None], begin_us, end_us)

    centre_m, along_m = np.array([lamp.x_m, lamp.y_m, lamp.z_m]), np.array([0.0, lamp.height_m, 0.0])
    period_us = 1e6 / lamp.flicker_hz
    return Source(centre_m, along_m, lamp.width_m, (-0.5, 0.5), lamp.light_w_m2, period_us, switches)


def wiper_switches(wiper: WiperSpec, begin_us: float, end_us: float) -> tuple[Floats, Floats]:
    """Return when a wiper changes the light after `begin_us` and before `end_us`, and the share that passes.

    While an edge passes, the light changes linearly with time, in even steps of its logarithm.

    Returns:
        Times, us, float64 (n,); shares of the light from `begin_us` and from each of them on, float64 (n +
        1,).
    """
    if not wiper.share:
        return np.empty(0), np.ones(1)
    lowest = 1 - wiper.share
    steps = max(1, math.ceil(-math.log(lowest) / _WIPER_STEP_LN))
    # Step i falls as the line passes the geometric mean of its level and the one before.
    levels = lowest ** (np.arange(1, steps + 1) / steps)
    fall_us = (1 - lowest ** ((np.arange(steps) + 0.5) / steps)) / wiper.share * wiper.edge_s * 1e6
    once_us = np.concatenate([fall_us, wiper.lasts_s * 1e6 - fall_us[::-1]])
    once = np.concatenate([levels, np.append(1.0, levels[:-1])[::-1]])
    first_us, every_us = wiper.at_s * 1e6, wiper.every_s * 1e6
    wipes = np.zeros(1)
    if every_us > 0:
        first, last = (max(0, math.floor((t_us - first_us) / every_us)) for t_us in (begin_us, end_us))
        wipes = np.arange(first, last + 1, dtype=np.float64) * every_us
    when: Floats = (first_us + wipes[:, None] + once_us).ravel()
    return cut_changes(when, np.append(1.0, np.tile(once, len(wipes))), begin_us, end_us)


def background_switches(background: BackgroundSpec, begin_us: float, end_us: float) -> tuple[Floats, Floats]:
    """Return changes of the background, as `wiper_switches`: its light in multiples of `light_w_m2`."""
    when, held = [np.empty(0)], [np.array([share for _, share in background.change_s[:1]] or [1.0])]
    for (from_s, first), (to_s, last) in pairwise(background.change_s):
        steps = math.ceil(abs(math.log(last / first)) / _BACKGROUND_STEP_LN)
        at = np.arange(steps)
        when.append((from_s + (at + 0.5) / steps * (to_s - from_s)) * 1e6)
        held.append(first * (last / first) ** ((at + 1) / steps))
    return cut_changes(np.concatenate(when), np.concatenate(held), begin_us, end_us)


def reflections_of(scene: Scene, bar: int) -> tuple[ReflectionSpec, ...]:
    """Return the reflections of a bar of a scene."""
    return tuple(one for one in scene.reflections if one.bar in (None, bar))


def _draw_lamps(scene: Scene) -> list[LampSpec]:
    """Draw lamps as streets have them, at random places in view: mains lamps, LEDs, signs."""
    rng = np.random.default_rng([scene.seed, 0x1A])
    lamps = []
    for _ in range(scene.flicker_lamps):
        depth = rng.uniform(0.5, 1.5) * scene.motion.distance_m
        half = scene.camera.width / 2 / scene.camera.focal_px * depth
        flicker_hz = float(rng.choice([100.0, 120.0, 400.0, 1000.0, 2000.0]))
        lamps.append(
            LampSpec(
                x_m=float(rng.uniform(-0.9, 0.9) * half),
                y_m=float(-rng.uniform(0.1, 0.5) * half),
                z_m=float(depth - scene.motion.distance_m),
                width_m=float(rng.uniform(0.02, 0.06)),
                height_m=float(rng.uniform(0.02, 0.06)),
                light_w_m2=float(10 ** rng.uniform(0, 1.5)),
                flicker_hz=flicker_hz,
                waveform="sine" if flicker_hz < 200 else "square",
                duty=float(rng.uniform(0.2, 0.8)),
                phase=float(rng.random()),
                depth=float(rng.uniform(0.2, 0.95)),
            )
        )
    return lamps


def sources_of(scene: Scene, registry: Registry | None = None) -> tuple[list[BarLight], list[Source]]:
    """Return the light of the bars and the lamps of a scene.

    Raises:
        ConfigError: A bar cannot send its payload, or the strips are too many.
        InputError: A file of chips cannot be read.
    """
    links = links_of(scene, registry)
    sites = sites_of(scene, registry) if scene.world is not None else (None,) * len(scene.bars)
    bars = [
        BarLight(
            bar,
            link,
            scene.lens,
            scene.seed + i,
            f"bars.{i}",
            i + 1 if bar.transmitter_id is None else bar.transmitter_id,
            site,
            reflections_of(scene, i),
        )
        for i, (bar, link, site) in enumerate(zip(scene.bars, links, sites, strict=True))
    ]
    lamps = [make_lamp_source(lamp) for lamp in (*scene.lamps, *_draw_lamps(scene))]
    columns = sum(len(bar.strips) + len(bar.images) for bar in bars)
    if columns + len(lamps) > MAX_SOURCES:
        raise ConfigError(
            f"bars and lamps: {columns} columns and rows of LEDs and {len(lamps)} lamps, expected at most"
            f" {MAX_SOURCES} together, reflections included"
        )
    return bars, lamps
