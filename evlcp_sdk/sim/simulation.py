"""Render a scene to events, block by block of time in constant memory."""

import math
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.scene.optics import Blur, edge_profile
from evlcp_sdk.sim import _kernels
from evlcp_sdk.sim.light import Source, background_switches, sources_of, wiper_switches
from evlcp_sdk.sim.motion import CameraPath, project
from evlcp_sdk.sim.optics import blur_of, tabulate_strip, undo_drops
from evlcp_sdk.sim.scene import NEAREST_M, Scene, SensorSpec
from evlcp_sdk.values import Events

Floats = NDArray[np.float64]

_Requests = tuple[Floats, NDArray[np.int32]]
"""Readout requests of pixels: times, us, and codes."""

ACTIVITY_FLOOR = 0.1
"""Least change of the log signal by a source for a pixel to be simulated, ln units."""

MOTION_STEP_PX = 0.1
"""Motion of the image after which the light on the pixels is computed again, px."""

_CELL_US = 1000.0
_CELLS = 4
_BLOCK_US = _CELLS * _CELL_US
_BLOCKS_AT_ONCE = 8
_FAR_PX = (3.0, 6.0, 12.0)  # distances beyond each of which the motion step doubles
_DEPTH_STEP = 0.0026  # of the depth
_MAX_MOVES = 40
_MAX_MOVES_STRUCK = 400
_BLOOM_EVERY = 8  # poses
_NEAR_NODES = 64
_NEAR_SCALE = 5.0
_WIDE_NODES = 1025
_ROOM = 1 << 17
_PARTS = 6  # a thread, of the pixels of a block
_TEXTURE_SIZE = 512
_MASK64 = 2**64 - 1


def pack_sensor(sensor: SensorSpec) -> Floats:
    """Pack the parameters of a sensor for the kernels, float64 (13,)."""
    s = sensor
    widest = math.exp(_kernels.NOISE_LIMIT * s.noise_ln)
    return np.array(
        [
            *(s.charge_us_w_m2, s.refr_us, s.dly_on_us, s.dly_off_us, s.jitter_us, s.p_on_miss, s.p_off_miss),
            *(s.noise_ln, widest, s.th_on, s.th_off, s.th_spread, s.tau_sf_us),
        ]
    )


def tabulate_quantiles() -> Floats:
    """Tabulate the quantiles of the cut-off normal distribution at even steps of probability."""
    edge = ndtr(-_kernels.NOISE_LIMIT)
    return ndtri(edge + np.linspace(0, 1, 4097) * (1 - 2 * edge))


def seed_key(seed: int) -> np.uint64:
    """Return the key of the kernels' hash for a seed."""
    return np.uint64((seed * 0x9E3779B97F4A7C15 + 0x632BE59BD9B4E019) & _MASK64)


def pack_requests(t_us: Floats, code: NDArray[np.int32], begin_us: float) -> NDArray[np.int64]:
    """Pack requests into words, with their times since `begin_us` to the nearest tick, int64 (n,)."""
    ticks = np.rint((t_us - begin_us) * _kernels.TICKS).astype(np.int64)
    return ticks << _kernels.CODE_BITS | code


def _draw_texture(scene: Scene) -> Floats:
    """Draw the background light relative to its mean: a periodic log-normal field, float64 (512, 512)."""
    n = _TEXTURE_SIZE
    rng = np.random.default_rng([scene.seed, 0x7E])
    # White noise through a Gaussian filter, drawn within 9 of its sigmas.
    sigma = 1 / (math.pi * scene.background.texture_px)
    k = min(n // 2 - 1, math.ceil(9 * sigma * n))
    rows = np.arange(-k, k + 1)
    noise = rng.normal(size=(2, 2 * k + 1, k + 1))
    gain = np.exp(-0.5 * (rows[:, None] ** 2 + rows[None, k:] ** 2) / (sigma * n) ** 2)
    # Components that are constant along a row are drawn together with their opposites.
    gain[:, 0] *= math.sqrt(2)
    spectrum = np.zeros((n, n // 2 + 1), complex)
    spectrum[rows, : k + 1] = (noise[0] + 1j * noise[1]) * gain
    log_light = np.fft.irfft2(spectrum, s=(n, n))
    log_light -= log_light.mean()
    log_light *= scene.background.texture / log_light.std()
    light = np.exp(log_light)
    return np.ascontiguousarray(light / light.mean())


def _merge_pixels(
    marked: list[NDArray[np.int64]], far: list[NDArray[np.uint8]]
) -> tuple[NDArray[np.int32], NDArray[np.uint64], NDArray[np.uint8]]:
    """Merge lists of pixels: sorted pixels, a bit mask of the lists of each, and its least distance."""
    if not marked:
        return np.empty(0, np.int32), np.empty(0, np.uint64), np.empty(0, np.uint8)
    pixels, beyond = np.concatenate(marked), np.concatenate(far)
    bits = np.repeat(np.uint64(1) << np.arange(len(marked), dtype=np.uint64), [len(m) for m in marked])
    if len(marked) > 1:
        order = np.argsort(pixels, kind="stable")
        pixels, bits, beyond = pixels[order], bits[order], beyond[order]
        first = np.flatnonzero(np.append(True, pixels[1:] != pixels[:-1]))
        pixels, bits = pixels[first], np.bitwise_or.reduceat(bits, first)
        beyond = np.minimum.reduceat(beyond, first)
    return pixels.astype(np.int32), bits, beyond


@dataclass(frozen=True, eq=False)
class _Halo:
    """A wide Gaussian that holds a share of the light.

    Attributes:
        share: Share of the light.
        reach_px: How far around an edge it is sampled.
        nodes_px: The samples, -reach_px to reach_px, float64 (1025,).
        table: Share of a pixel lit beyond an edge at each of them, float64 (1025,).
        per_px: Samples per pixel along a strip.
        every: Poses after which it is placed in the image again; 0 for once in a block of time.
    """

    share: float
    reach_px: float
    nodes_px: Floats
    table: Floats
    per_px: float
    every: int

    @classmethod
    def of(cls, share: float, sigma_px: float, every: int) -> "_Halo":
        reach = 4.5 * sigma_px + 1
        nodes = np.linspace(-reach, reach, _WIDE_NODES)
        return cls(share, reach, nodes, edge_profile(nodes, sigma_px), 8 / sigma_px, every)

    def edge_share(self, at_px: Floats) -> Floats:
        """Return the share of a pixel lit at a distance beyond an edge."""
        return np.interp(at_px, self.nodes_px, self.table)

    def cluster_shares(self, cuts_px: Floats) -> Floats:
        """Return the share of each cluster's light along a strip with these cuts, float64 (clusters, n)."""
        grid = np.arange(-self.reach_px, cuts_px[-1] + self.reach_px, 1 / self.per_px)
        edge = self.edge_share(grid[:, None] - cuts_px)
        return (edge[:, :-1] - edge[:, 1:]).T


def _make_time_line(
    starts_us: Floats,
    wiped: tuple[Floats, Floats],
    changed_us: Floats,
    sent: list[tuple[Floats, Floats]],
    halos_of: list[list[Floats]],
    most: int,
) -> tuple[_kernels.TimeLine, Floats, Floats]:
    """Merge the changes of light in a block into one time line, with the levels of the sources.

    Args:
        starts_us: Start of each pose, the block's first, float64 (poses,).
        wiped: Times at which the share of all light that passes changes, float64 (n,), and the shares from
            the block's start on, float64 (n + 1,).
        changed_us: Times at which the background's light changes.
        sent: Times of switching and levels of each source, see `Source.switches`, m of the former.
        halos_of: Light of each source in each halo on a grid, float64 (m + 1, places), halo by halo.
        most: Most clusters of a source.

    Returns:
        The time line, the levels of `Strips`, and the light of `Halos`.
    """
    sources = len(sent)
    parts = [starts_us, wiped[0], changed_us, *(when for when, _ in sent)]
    when = np.concatenate(parts)
    # Kinds of entries: a pose, a step of the wiper or of the background, or a source that switches.
    kind = np.repeat([-2, -1, -3, *range(sources)], [len(part) for part in parts])
    order = np.argsort(when, kind="stable")
    when, kind = when[order], kind[order]
    counts = [len(shown) for _, shown in sent]
    row = np.cumsum(kind == np.arange(sources)[:, None], axis=1)
    row += np.cumsum([0, *counts])[:-1, None]
    levels = np.zeros((sum(counts), most))
    places = max((light.shape[1] for halo in halos_of for light in halo), default=1) + 1
    halo = np.zeros((len(halos_of), sum(counts), places))
    begin = 0
    for i, count in enumerate(counts):
        levels[begin : begin + count, : sent[i][1].shape[1]] = sent[i][1]
        for q, light in enumerate(halos_of):
            halo[q, begin : begin + count, : light[i].shape[1]] = light[i]
        begin += count
    pose, wipes, steps = (np.cumsum(kind == code) for code in (-2, -1, -3))
    kind[kind == -3] = -1
    line = _kernels.TimeLine(when, kind, pose - 1, wiped[1][wipes], steps, row)
    return line, levels, halo


def _make_batches(
    pixels: NDArray[np.int32], masks: NDArray[np.uint64], far: NDArray[np.uint8], most_poses: int
) -> tuple[NDArray[np.int32], NDArray[np.int64], NDArray[np.uint64], NDArray[np.int64]]:
    """Batch pixels that the same sources light from similar distances.

    They follow the motion of the sources every `most_poses` at least.

    Returns:
        Pixels, batches, masks and strides of `ActivePixels`.
    """
    if not len(pixels):
        return pixels, np.zeros(1, np.int64), masks, np.zeros(0, np.int64)
    order = np.argsort(far, kind="stable")
    pixels, masks, far = pixels[order], masks[order], far[order]
    if (masks != masks[0]).any():
        order = np.argsort(masks, kind="stable")
        pixels, masks, far = pixels[order], masks[order], far[order]
    cuts = np.flatnonzero(masks[1:] != masks[:-1]) + 1
    edges = [0, *cuts.tolist(), len(pixels)]
    begins = np.concatenate([np.arange(a, b, _kernels.LANES) for a, b in pairwise(edges)])
    # The first pixel of a batch is the closest.
    strides = np.minimum(np.int64(1) << far[begins].astype(np.int64), most_poses)
    return pixels, np.append(begins, len(pixels)), masks[begins], strides


@dataclass(frozen=True, eq=False)
class _Footprint:
    """The light of a source around its image, at a depth.

    Attributes:
        depth_m: The depth.
        blur: The image of a point.
        near: The table of `tabulate_strip`.
        scale_px: The scale of that.
        z_px: Distances, px, float64 (n,).
        across: Light of an endless strip at each from its middle, W/m2, float64 (n,).
        along: Light in the middle of a strip at each before its end, W/m2, float64 (n,).
        halos: Share of each cluster's light in each halo on a grid, float64 (clusters, places), halo by halo.
    """

    depth_m: float
    blur: Blur
    near: Floats
    scale_px: float
    z_px: Floats
    across: Floats
    along: Floats
    halos: list[Floats]

    def reach_px(self, least_w_m2: float) -> tuple[float, float]:
        """Return how far across it and before its ends it gives this light."""
        across = self.z_px[self.across >= least_w_m2].max(initial=0)
        along = self.z_px[self.along >= least_w_m2].max(initial=0)
        return float(across), float(along)


_Block = tuple[_kernels.ActivePixels, tuple[Any, ...]]
"""The active pixels of a block of time, and the light on them, as arguments of `run_pixels`."""


class Simulation:
    """Renders a scene; streamed once.

    Time passes in blocks of 4 ms. In each, the pixels that a source may excite are run from edge to edge of
    the light, and their sorted events go through the readout. The light on a pixel changes when a source
    switches and when the image has moved by `MOTION_STEP_PX`; there is no other time step.

    Args:
        scene: The scene.
        seed: A seed instead of the scene's.
        threads: Threads that share the pixels; the events do not depend on it.
        registry: The algorithms of its links; None for all that are installed.

    Attributes:
        counts: Events written and dropped so far; signal events are counted before the readout.
        hot_pixels: Number of hot pixels.
        done_s: How much of the scene is rendered, s.

    Raises:
        ConfigError: The scene cannot be rendered.
        InputError: One of its files cannot be read.
    """

    def __init__(
        self, scene: Scene, seed: int | None = None, threads: int = 1, registry: Registry | None = None
    ) -> None:
        self.scene = scene if seed is None else replace(scene, seed=seed)
        scene = self.scene
        self.bars, self.lamps = sources_of(scene, registry)
        strips = [strip for bar in self.bars for strip in (*bar.strips, *bar.images)]
        self._sources: list[Source] = [*strips, *self.lamps]
        self.path = CameraPath(scene.motion, scene.duration_s, scene.seed)
        _, depth = project(
            np.array([bar.centre_m for bar in self.bars]).reshape(-1, 3),
            *self.path.sample([0.0]),
            scene.camera,
        )
        for i in np.flatnonzero(depth[0] <= NEAREST_M):
            raise ConfigError(
                f"bars.{i}: the bar is behind the camera as the scene starts (depth {depth[0, i]:.2f} m)"
            )
        self._threads = max(1, threads)
        quantiles = tabulate_quantiles()
        shifts = np.exp(scene.sensor.noise_ln * quantiles)
        self._model = _kernels.PixelModel(seed_key(scene.seed), pack_sensor(scene.sensor), quantiles, shifts)
        self._texture = _draw_texture(scene)
        self._darkest_texture = float(self._texture.min())
        self._ends_m = np.array([s.cuts_m()[[0, -1]] for s in self._sources]).reshape(-1, 3)
        size = scene.camera.width * scene.camera.height
        self._state = np.zeros((size, 8))
        self._counters = np.zeros((size, 3), np.int64)
        rng = np.random.default_rng([scene.seed, 0x40])
        self.hot_pixels = int(rng.binomial(size, scene.sensor.hot_share))
        self._hot = rng.choice(size, self.hot_pixels, replace=False)
        self._halos = [_Halo.of(scene.lens.halo, scene.lens.halo_px, 0)]
        # A narrow halo follows the image; a wide one changes little in 4 ms.
        self._texture_every = max(1, round(scene.background.texture_step_px / MOTION_STEP_PX))
        if scene.lens.bloom > 0:
            self._halos.append(_Halo.of(scene.lens.bloom, scene.lens.bloom_px, _BLOOM_EVERY))
        self._halo_columns = (
            np.array([-one.reach_px for one in self._halos]),
            np.array([one.per_px for one in self._halos]),
            np.array([one.share for one in self._halos]),
            np.array([one.every for one in self._halos]),
            np.stack([one.table for one in self._halos]),
            np.array([(_WIDE_NODES - 1) / (2 * one.reach_px) for one in self._halos]),
        )
        self._near_share = 1 - sum(halo.share for halo in self._halos)
        self._wide_reach = max(halo.reach_px for halo in self._halos)
        self.counts = dict.fromkeys(("events", "signal_events", "dropped_by_rate_cap", "dropped_blind"), 0)
        self.done_s = 0.0
        self._footprints: dict[int, _Footprint] = {}

    def stream(self) -> Iterator[Events]:
        """Yield the events in order of time, in pieces of up to a block."""
        end_us = self.scene.duration_s * 1e6
        spans = [
            (number, number * _BLOCK_US, min((number + 1) * _BLOCK_US, end_us))
            for number in range(math.ceil(end_us / _BLOCK_US))
        ]
        readout, poses = _Readout(self), self._sample_poses()
        # While the pixels of a block run, the next is prepared, and the events of the last are read out.
        with ThreadPoolExecutor(self._threads) as pool:
            prepared = pool.submit(self._prepare_block, poses, *spans[0])
            served: Future[Events] | None = None
            for number, begin, end in spans:
                block = prepared.result()
                if end < end_us:
                    prepared = pool.submit(self._prepare_block, poses, *spans[number + 1])
                running = [pool.submit(job) for job in self._make_jobs(block, begin, end)]
                # The caller handles the events while the pixels run.
                if served is not None:
                    yield from self._publish(served.result(), begin)
                signal = [part for one in running for part in one.result()]
                served = pool.submit(readout.read_block, number, end, signal)
            if served is not None:
                yield from self._publish(served.result(), end_us)

    def _publish(self, events: Events, end_us: float) -> Iterator[Events]:
        self.done_s = end_us * 1e-6
        if len(events):
            yield events

    def draw_noise(self, number: int, begin_us: float, end_us: float) -> tuple[Floats, NDArray[np.int32]]:
        """Draw Poisson events of the background and of hot pixels between two times: times and codes."""
        camera, sensor = self.scene.camera, self.scene.sensor
        size = camera.width * camera.height
        # A key of the block, a draw and a purpose, as in `hash_normal`.
        mix, key = cast(Any, _kernels.mix_bits).py_func, np.array([self._model.seed])
        key = mix(key + np.uint64(number) * np.array([_kernels.PIXEL_STEP], np.uint64))
        times, codes = [np.empty(0)], [np.empty(0, np.int64)]
        for purpose, rate_hz, population in (
            (10, 2 * sensor.noise_hz * size, size),
            (13, sensor.hot_hz * len(self._hot), len(self._hot)),
        ):
            rate = rate_hz * 1e-6
            expected = rate * max(end_us - begin_us, 0.0)
            if expected == 0:
                continue
            draws = np.arange(int(expected + 12 * math.sqrt(expected) + 64), dtype=np.uint64)
            words = key + draws * np.uint64(_kernels.DRAW_STEP)
            gap, place, sign = (
                (mix(words + np.uint64(purpose + k)) >> np.uint64(11)) / 2**53 for k in range(3)
            )
            t = np.cumsum(np.append(begin_us, -np.log(1.0 - gap) / rate))[1:]
            t = t[t < end_us]
            pixel = (place[: len(t)] * population).astype(np.int64)
            pixel = pixel if purpose == 10 else self._hot[pixel]
            row, column = np.divmod(pixel, camera.width)
            times.append(t)
            codes.append((row << _kernels.COLUMN_BITS | column) << 1 | (sign[: len(t)] < 0.5))
        return np.concatenate(times), np.concatenate(codes).astype(np.int32)

    def _make_jobs(
        self, block: _Block | None, begin_us: float, end_us: float
    ) -> list[Callable[[], list[_Requests]]]:
        """Return jobs that run parts of the active pixels through a block and return unsorted requests."""
        if block is None:
            return []
        active, world = block
        most = int((end_us - begin_us) / self.scene.sensor.refr_us) + 8
        cuts = [0, len(active.masks)]
        if self._threads > 1:
            # Ever smaller parts let all threads finish at about the same time.
            left = (1 - 0.5 / self._threads) ** np.arange(_PARTS * self._threads)
            cuts = (len(active.masks) * np.append(1 - left, 1)).astype(int).tolist()
        store = self._state, self._counters, self.scene.camera.width

        def run(first: int, last: int) -> list[_Requests]:
            found = []
            while first < last:
                size = max(_ROOM, _kernels.LANES * most)
                out = _kernels.Requests(np.empty(size), np.empty(size, np.int32), np.zeros(1, np.int64))
                first = _kernels.run_pixels(first, last, active, store, world, self._model, most, out)
                n = int(out.made[0])
                found.append((out.t_us[:n], out.code[:n]))
            return found

        return [partial(run, a, b) for a, b in pairwise(cuts) if a < b]

    def _sample_poses(self) -> Iterator[tuple[Floats, ...]]:
        """Yield each block's poses: starts, us, float64 (n,), and positions and attitudes, float64 (n, 3)."""
        edges = np.append(np.arange(0.0, self.scene.duration_s * 1e6, _BLOCK_US), self.scene.duration_s * 1e6)
        # Several blocks at once take less time; a pothole moves the image so fast that one has poses enough.
        blocks = 1 if self.scene.motion.pothole_s else _BLOCKS_AT_ONCE
        for first in range(0, len(edges) - 1, blocks):
            part = edges[first : first + blocks + 1]
            starts, middles = self._choose_poses(part[0], part[-1])
            cuts = np.searchsorted(starts, part[1:-1])
            columns = (starts, *self.path.sample(middles))
            yield from zip(*(np.split(column, cuts) for column in columns), strict=True)

    def _choose_poses(self, begin_us: float, end_us: float) -> tuple[Floats, Floats]:
        """Return starts and middles of poses, in which the image moves by one step, us, float64 (n,)."""
        cells = np.append(np.arange(begin_us, end_us, _CELL_US), end_us)
        t = np.linspace(cells[:-1], cells[1:], 3, axis=1)
        position, attitude = self.path.sample(t.ravel())
        turns = np.diff(attitude[:, :2].reshape(-1, 3, 2), axis=1)
        moved = np.abs(turns).max((1, 2)) * self.scene.camera.focal_px
        if len(self._ends_m):
            place, depth = project(self._ends_m, position, attitude, self.scene.camera)
            shown = (depth > NEAREST_M) & (np.abs(place) < 4 * self.scene.camera.width).all(2)
            # The end of a strip counts in the blocks in which it is always in view.
            blocks = np.arange(0, len(t), _CELLS)
            counts = np.logical_and.reduceat(shown.reshape(len(t), 3, -1).all(1), blocks)
            step = np.diff(place.reshape(len(t), 3, -1, 2), axis=1)
            length = np.hypot(step[..., 0], step[..., 1]).max(1)
            shown_px = np.where(counts[np.arange(len(t)) // _CELLS], length, 0.0)
            moved = np.maximum(moved, shown_px.max(1))
        motion = self.scene.motion
        most = _MAX_MOVES_STRUCK if motion.pothole_s or motion.yaw_rate_deg_s else _MAX_MOVES
        moves = np.clip(np.ceil(2 * moved / MOTION_STEP_PX), 1, most).astype(int)
        starts = np.concatenate(
            [a + np.arange(n) / n * (b - a) for a, b, n in zip(cells, cells[1:], moves, strict=False)]
        )
        middles = 0.5 * (starts + np.append(starts[1:], end_us))
        return starts, middles

    def _make_footprint(self, source: Source, depth_m: float, strip_px: float, cuts_px: Floats) -> _Footprint:
        """Compute the light around a source at a depth, with its clusters cut at these places along it."""
        scene = self.scene
        blur = blur_of(depth_m, scene.lens, scene.camera, source.image.blur_px if source.image else 0.0)
        scale = _NEAR_SCALE * float(blur.sigma_px[0])
        near = tabulate_strip(blur, strip_px, scale, _NEAR_NODES)
        z = np.arange(0, self._wide_reach, 0.25)
        half = strip_px / 2
        node, nodes = _NEAR_NODES * z / (z + scale), np.arange(_NEAR_NODES + 1)
        across = self._near_share * np.interp(node, nodes, near[:, -1])
        along = self._near_share * np.interp(node, nodes, near[0, _NEAR_NODES::-1])
        for halo in self._halos:
            part = halo.edge_share(z + half) - halo.edge_share(z - half)
            across += halo.share * part
            along += halo.share * part[0] * halo.edge_share(-z)
        light = source.light_w_m2
        halos = [halo.cluster_shares(cuts_px) for halo in self._halos]
        return _Footprint(depth_m, blur, near, scale, z, light * across, light * along, halos)

    def _prepare_block(
        self, sampled: Iterator[tuple[Floats, ...]], number: int, begin_us: float, end_us: float
    ) -> _Block | None:
        """Prepare the block of the next poses: sources, their switching, and the pixels they may excite."""
        scene = self.scene
        camera, sensor = scene.camera, scene.sensor
        starts, position, attitude = next(sampled)
        turn = np.stack([attitude[:, 0], -attitude[:, 1]], 1) * camera.focal_px
        wiped = wiper_switches(scene.wiper, begin_us, end_us)
        changed = background_switches(scene.background, begin_us, end_us)
        lightest = float(wiped[1].max())
        light = np.append(sensor.dark_w_m2, scene.background.light_w_m2 * changed[1])
        darkest = float(light[0] + light[1:].min() * float(self._darkest_texture * wiped[1].min()))
        shown: list[tuple[Source, Floats, Floats, Floats, Floats, _Footprint]] = []
        marked: list[NDArray[np.int64]] = []
        beyond: list[NDArray[np.uint8]] = []
        for i, source in enumerate(self._sources):
            place, depth = self.project_source(source, position, attitude)
            if depth.min() <= NEAREST_M:
                continue
            middle_depth = depth.mean(1)
            strip_px = camera.focal_px * source.width_m / middle_depth
            vector = place[:, -1] - place[:, 0]
            axis = vector / np.hypot(*vector.T)[:, None]
            bounds = ((place - place[:, :1]) * axis[:, None]).sum(-1)
            m = len(place) // 2
            depth_m = float(middle_depth[m])
            footprint = self._footprints.get(i)
            if footprint is None or abs(depth_m / footprint.depth_m - 1) > _DEPTH_STEP:
                # At the depth halfway through its time of use.
                nearer = 1 + _DEPTH_STEP * float(np.sign(middle_depth[0] - middle_depth[-1]))
                width_px = float(strip_px[m]) * nearer
                footprint = self._make_footprint(source, depth_m / nearer, width_px, bounds[m] * nearer)
                self._footprints[i] = footprint
            least = ACTIVITY_FLOOR * max(darkest, sensor.charge_us_w_m2 / source.longest_us)
            lit, far = self._find_lit_pixels(place, 0.5 * float(strip_px.max()), footprint, least / lightest)
            if len(lit):
                marked.append(lit)
                beyond.append(far)
                shown.append((source, place, strip_px, axis, bounds, footprint))
        around = scene.background.around_px
        if not shown and around < camera.width:
            return None
        pixels, masks, far = _merge_pixels(marked, beyond)
        if around > 0:
            pixels, masks, far = self._add_background(pixels, masks, far, [place for _, place, *_ in shown])

        g, poses = len(shown), len(starts)
        most = max((source.clusters for source, *_ in shown), default=1)
        origin, axis = np.empty((2, g, poses)), np.empty((2, g, poses))
        bounds, strips = np.zeros((g, most + 1, poses)), np.empty((g, poses))
        clusters, gain = np.empty(g, np.int64), np.empty(g)
        tables = np.empty((g, _NEAR_NODES + 1, 2 * _NEAR_NODES + 1))
        near_scale, near_reach = np.empty(g), np.empty(g)
        for i, (source, place, strip_px, along, cuts, footprint) in enumerate(shown):
            k = source.clusters
            axis[:, i] = along.T
            origin[:, i] = place[:, 0].T
            bounds[i, : k + 1] = cuts.T
            strips[i], clusters[i], gain[i] = strip_px, k, source.light_w_m2
            near_scale[i], near_reach[i] = footprint.scale_px, footprint.blur.reach_px
            tables[i] = footprint.near
        sent = [source.switches(begin_us, end_us) for source, *_ in shown]
        halos_of = [
            [levels @ one[-1].halos[q] for one, (_, levels) in zip(shown, sent, strict=True)]
            for q in range(len(self._halos))
        ]
        line, levels, halo = _make_time_line(starts, wiped, changed[0], sent, halos_of, most)
        world = (
            line,
            _kernels.Strips(levels, origin, axis, bounds, strips, clusters, gain),
            _kernels.Halos(halo, *self._halo_columns),
            _kernels.Cores(self._near_share, tables, near_scale, near_reach),
            _kernels.Background(turn, self._texture_every, self._texture, light),
        )
        batches = _make_batches(pixels, masks, far, self._texture_every)
        at_px = undo_drops(scene.drops, *np.divmod(batches[0], camera.width), (begin_us + end_us) * 0.5e-6)
        return _kernels.ActivePixels(number, end_us, *batches, at_px), world

    def project_source(self, source: Source, position: Floats, attitude: Floats) -> tuple[Floats, Floats]:
        """Project the cuts between a source's clusters into the image, with their depths; see `project`."""
        image = source.image
        if image is None or image.kind != "window":
            return project(source.cuts_m(), position, attitude, self.scene.camera)
        # Light from further right is light for a camera turned further left.
        right, down = map(math.radians, image.turn_deg)
        turned = attitude + np.array([-right, down, 0.0])
        place, depth = project(source.cuts_m(), position, turned, self.scene.camera)
        return place + np.array(image.shift_px), depth

    def _add_background(
        self,
        pixels: NDArray[np.int32],
        masks: NDArray[np.uint64],
        far: NDArray[np.uint8],
        places: list[Floats],
    ) -> tuple[NDArray[np.int32], NDArray[np.uint64], NDArray[np.uint8]]:
        """Add pixels around the sources, on which only the background moves, in the order of pixels."""
        width, height = self.scene.camera.width, self.scene.camera.height
        around = self.scene.background.around_px
        marked = np.full((height, width), around >= width)
        for place in places:
            left, top = np.clip(np.floor(place.min((0, 1))) - around, 0, (width, height)).astype(int)
            right, low = np.clip(np.ceil(place.max((0, 1))) + around + 1, 0, (width, height)).astype(int)
            marked[top:low, left:right] = True
        flat = marked.ravel()
        flat[pixels] = True
        every = np.flatnonzero(flat).astype(np.int32)
        found, near = np.zeros(len(every), np.uint64), np.zeros(len(every), np.uint8)
        known = np.searchsorted(every, pixels)
        found[known], near[known] = masks, far
        return every, found, near

    def _find_lit_pixels(
        self, place: Floats, half_px: float, footprint: _Footprint, least_w_m2: float
    ) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        """Find pixels, row by row, that a source lights by `least_w_m2` or more at any pose.

        Returns:
            The pixels, and how many of `_FAR_PX` they are beyond the strip, which is twice `half_px` wide.
        """
        if footprint.across[0] < least_w_m2:
            return np.empty(0, np.int64), np.empty(0, np.uint8)
        bend_px = sum(abs(drop.bend_px) for drop in self.scene.drops)
        reach_across, reach_along = (reach + 0.5 + bend_px for reach in footprint.reach_px(least_w_m2))
        middle = place[len(place) // 2]
        vector = middle[-1] - middle[0]
        length = float(np.hypot(*vector))
        axis = vector / length
        # How far the strip moves across and along itself from the middle pose.
        offset = place[:, [0, -1]] - middle[[0, -1]]
        along = reach_along + float(np.abs(offset @ axis).max())
        across = reach_across + float(np.abs(offset @ np.array([axis[1], -axis[0]])).max())
        ends, reach = middle[[0, -1]], np.abs(axis) * along + np.abs(axis[::-1]) * across
        size = self.scene.camera.width, self.scene.camera.height
        left, top = np.floor(ends.min(0) - reach).clip(0, size).astype(int)
        right, low = (np.ceil(ends.max(0) + reach) + 1).clip(0, size).astype(int)
        y, x = np.mgrid[top:low, left:right]
        dx, dy = x - middle[0, 0], y - middle[0, 1]
        aside, ahead = np.abs(dx * axis[1] - dy * axis[0]), np.abs(dx * axis[0] + dy * axis[1] - 0.5 * length)
        lit = (aside <= across) & (ahead <= 0.5 * length + along)
        distance_px = np.maximum(aside[lit] - half_px, ahead[lit] - 0.5 * length) - bend_px
        far = sum(
            ((distance_px >= px).view(np.uint8) for px in _FAR_PX), np.zeros(len(distance_px), np.uint8)
        )
        return (y * size[0] + x)[lit], far


def _shift_requests(words: NDArray[np.int64], later_us: float) -> NDArray[np.int64]:
    # Requests that have waited for very long keep a time that fits into a word.
    ticks = np.maximum((words >> _kernels.CODE_BITS) - int(later_us * _kernels.TICKS), -(1 << 35))
    return np.asarray(ticks << _kernels.CODE_BITS | words & ((1 << _kernels.CODE_BITS) - 1))


class _Readout:
    """Reads out the pixels' requests, block by block of time.

    Args:
        simulation: The simulation, which has the scene, the noise and the counts.
    """

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        sensor, camera = simulation.scene.sensor, simulation.scene.camera
        early_us = min(sensor.dly_on_us, sensor.dly_off_us) - _kernels.NOISE_LIMIT * sensor.jitter_us
        self._early_us = max(0.0, early_us)
        self._begin_us = 0.0
        # Requests too late for the last block, and those waiting at its end, since its start.
        self._later, self._queue = np.empty(0, np.int64), np.empty(0, np.int64)
        self._blind_us = np.zeros(camera.width * camera.height)
        self._memory = np.array([-1e18, -1.0, -1.0, 0.0])
        self._pending = np.zeros((camera.height, camera.width) if sensor.hold else (0, 0), bool)
        self._noise_from_us = 0.0

    def read_block(self, number: int, end_us: float, signal: list[_Requests]) -> Events:
        """Return the events that are certain after the requests of the block that ends at this time."""
        simulation = self._simulation
        sensor, camera = simulation.scene.sensor, simulation.scene.camera
        scene_end_us = simulation.scene.duration_s * 1e6
        is_last = end_us == scene_end_us
        safe = math.inf if is_last else end_us + self._early_us
        noise_to = min(end_us if is_last else safe, scene_end_us)
        noise = simulation.draw_noise(number, self._noise_from_us, noise_to)
        self._noise_from_us = end_us if is_last else safe
        simulation.counts["signal_events"] += sum(len(t) for t, _ in signal)
        begin = number * _BLOCK_US
        later, queue = (
            _shift_requests(words, begin - self._begin_us) for words in (self._later, self._queue)
        )
        self._begin_us = begin
        parts = [pack_requests(when, code, begin) for when, code in (*signal, noise)]
        # Waiting requests come first.
        words, waiting = np.concatenate([queue, later, *parts]), len(queue)
        new = words[waiting:]
        new.sort()
        cut = len(new)
        if not is_last:
            cut = int(np.searchsorted(new, int((safe - begin) * _kernels.TICKS) << _kernels.CODE_BITS))
        self._later = new[cut:].copy()
        kept = _kernels.drop_blind_requests(new[:cut], begin, self._blind_us, camera.width, sensor.refr_us)
        words = words[: waiting + kept]
        n = len(words)
        columns = np.empty(n, np.int64), np.empty(n, np.uint16), np.empty(n, np.uint16), np.empty(n, np.uint8)
        cap = round(sensor.cap_mev_s * sensor.cap_window_us)
        cap = max(cap, 1) if sensor.cap_mev_s > 0 else 0
        times_us, limit = (begin, sensor.t_row_us, safe), (cap, sensor.cap_window_us)
        written, dropped, held, left = _kernels.read_out(
            words, times_us, camera.height, limit, self._memory, self._pending, columns
        )
        self._queue = words[:left].copy()
        simulation.counts["dropped_blind"] += cut - kept + held
        simulation.counts["events"] += written
        simulation.counts["dropped_by_rate_cap"] += dropped
        columns[0][:written] += simulation.scene.t0_us
        return Events(columns[0][:written], columns[1][:written], columns[2][:written], columns[3][:written])
