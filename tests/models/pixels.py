"""Measurements on single pixels and on the readout, for the tests and the figures of `docs/simulator.md`."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.sim import BackgroundSpec, Scene, Simulation, _kernels
from evlcp_sdk.sim.simulation import pack_requests
from evlcp_sdk.values import Events

Floats = NDArray[np.float64]

_WIDTH = 256

MEASURED_LATENCY = {0.006: (555, 635), 0.046: (95, 117), 0.166: (42, 55), 0.277: (32, 43), 0.398: (27, 40)}
"""Measured mean latency of the first ON and OFF event, us, at an irradiance, W/m2: the sensor model's table,
from usnistgov/pixel_latency_eventcameras."""

MEASURED_AREA = {32: 37, 64: 40, 128: 45, 256: 62, 420: 90}
"""Measured mean latency, us, of a lit square of this side, px; the same source."""


@dataclass(frozen=True, eq=False)
class PixelEvents:
    """Events of pixels that all saw the same light, before the readout, pixel by pixel.

    Attributes:
        pixel: Number of the pixel, int64 (n,).
        request_us: When each asked to be read out, float64 (n,).
        on: Whether it is an ON event, bool (n,).
    """

    pixel: NDArray[np.int64]
    request_us: Floats
    on: NDArray[np.bool_]


def pixel_events(sensor, edge_us, light_w_m2, end_us, *, pixels=1, seed=0):
    """Run pixels, at rest in the first light, through light that changes at given times, by more than 0.1 %.

    Args:
        sensor: Its pixels.
        edge_us: When each light starts, rising, (n,).
        light_w_m2: The lights, background and dark current included, (n,).
        end_us: End of the last.
        pixels: How many pixels, each with its own thresholds and noise.
        seed: Of thresholds and noise.
    """
    begin_us = float(np.ravel(edge_us)[0])
    scene = Scene(
        seed=seed,
        camera=CameraModel(width=_WIDTH, height=-(-pixels // _WIDTH)),
        sensor=replace(sensor, hot_share=0.0),
        background=BackgroundSpec(around_px=_WIDTH),
        bars=(),
    )
    simulation = Simulation(scene)
    prepared = simulation._prepare_block(simulation._sample_poses(), 0, 0.0, 1000.0)
    assert prepared is not None
    active, (_, strips, halos, near, scenery) = prepared
    number = np.arange(pixels, dtype=np.int32)
    begins = np.append(np.arange(0, pixels, _kernels.LANES), pixels)
    batches = np.ones(len(begins) - 1, np.int64)
    active = _kernels.ActivePixels(
        0, end_us, number, begins, batches.astype(np.uint64), batches, np.zeros((2, pixels))
    )
    # The light of an even background, of which a share passes that changes like a source that switches.
    light = np.array(light_w_m2, np.float64)
    none = np.zeros(len(light), np.int64)
    line = _kernels.TimeLine(
        np.array(edge_us, np.float64), none, none, light, none, np.zeros((0, len(light)), np.int64)
    )
    scenery = scenery._replace(field=np.ones_like(scenery.field), light=np.array([0.0, 1.0]))
    world = (line, strips, halos, near, scenery)
    parts = [part for job in simulation._make_jobs((active, world), begin_us, end_us) for part in job()]
    request, code = (np.concatenate(column) for column in zip(*parts, strict=True))
    row, column = code >> _kernels.COLUMN_BITS + 1, code >> 1 & (1 << _kernels.COLUMN_BITS) - 1
    pixel = row * np.int64(_WIDTH) + column
    order = np.argsort(pixel, kind="stable")
    return PixelEvents(pixel[order], request[order], code[order] % 2 == 1)


def latency_us(sensor, light_w_m2, dark_w_m2, *, pixels=400, seed=0):
    """Mean latency of the first ON event after a step up, and of the first OFF event after a step down, us.

    Before each step the pixels are at rest, and so are their references; no event goes missing.
    """
    sensor = replace(sensor, p_on_miss=0.0, p_off_miss=0.0)
    light = light_w_m2 + dark_w_m2
    means = []
    for before, after in ((dark_w_m2, light), (light, dark_w_m2)):
        events = pixel_events(sensor, [-1.0, 0.0], [before, after], 1e5, pixels=pixels, seed=seed)
        first = np.append(True, np.diff(events.pixel) > 0)
        means.append(float(events.request_us[first].mean()))
    return means[0], means[1]


def latency_with_readout_us(sensor, light_w_m2, side_px, *, seed=0):
    """Mean latency of the first ON event, readout included, of a square of pixels that light up at once."""
    sensor = replace(sensor, p_on_miss=0.0)
    one = pixel_events(
        sensor, [-1e5, 0.0], [1e-4, light_w_m2], sensor.refr_us / 2 + 1000, pixels=side_px**2, seed=seed
    )
    first = np.flatnonzero(np.append(True, np.diff(one.pixel) > 0))
    words = np.sort(words_of(one.request_us[first], *np.divmod(one.pixel[first], side_px)))
    return float(serve_requests(words, side_px, sensor.t_row_us)[0].t_us.mean() + 0.5)


def words_of(t_us, row, column):
    """Requests of ON events, as the readout takes them."""
    code = (np.asarray(row) << _kernels.COLUMN_BITS | np.asarray(column)) << 1 | 1
    return pack_requests(np.asarray(t_us, np.float64), code.astype(np.int32), 0.0)


def serve_requests(words, height, row_us, *, until_us=np.inf, limit=(0, 200), memory=None, pending=None):
    """What the readout makes of sorted requests: events, and `read_out`'s counts of others."""
    n = len(words)
    out = np.empty(n, np.int64), np.empty(n, np.uint16), np.empty(n, np.uint16), np.empty(n, np.uint8)
    memory = np.array([-1e18, -1.0, -1.0, 0.0]) if memory is None else memory
    pending = np.zeros((0, 0), np.bool_) if pending is None else pending
    written, dropped, held, left = _kernels.read_out(
        words, (0.0, row_us, until_us), height, limit, memory, pending, out
    )
    return Events(*(column[:written] for column in out)), dropped, held, left


def crossing_by_steps(sensor, light, begin_us, end_us, step_us=0.01):
    """Threshold crossings (us, ON) of one noiseless pixel, by integrating its log signal in small steps.

    dy/dt = (I - exp(y)) / Q by the classical Runge-Kutta method: the brute-force twin of the closed form.
    With a source follower, dz/dt = (y - z) / tau behind it, and z is compared.
    """
    charge, tau = sensor.charge_us_w_m2, sensor.tau_sf_us
    y = z = float(np.log(light(begin_us)))
    reference = z
    blind_until = begin_us
    blind = False
    found = []
    for i in range(round((end_us - begin_us) / step_us)):
        t = begin_us + i * step_us
        now = light(t + 0.5 * step_us)
        k1 = (now - np.exp(y)) / charge
        k2 = (now - np.exp(y + 0.5 * step_us * k1)) / charge
        k3 = (now - np.exp(y + 0.5 * step_us * k2)) / charge
        k4 = (now - np.exp(y + step_us * k3)) / charge
        before, ramp_from = z, y
        y += step_us * (k1 + 2 * k2 + 2 * k3 + k4) / 6
        z = y if tau == 0 else z + (0.5 * (ramp_from + y) - z) * -np.expm1(-step_us / tau)
        if blind and t + step_us >= blind_until:
            blind = False
            reference = before + (z - before) * (blind_until - t) / step_us
        if blind:
            continue
        for on, level in ((True, reference + sensor.th_on), (False, reference - sensor.th_off)):
            if (z >= level) if on else (z <= level):
                when = t + step_us * (level - before) / (z - before)
                found.append((when, on))
                blind, blind_until = True, when + sensor.refr_us
                break
    return found


def step_response(sensor, contrast, light_w_m2=20.0, *, pixels=4000, seed=0):
    """Share of pixels that send an ON event upon one step of log contrast: the S-curve, float64 (n,)."""
    shares = []
    for delta in np.atleast_1d(np.asarray(contrast, np.float64)):
        events = pixel_events(
            sensor, [0.0, 1000.0], [light_w_m2, light_w_m2 * np.exp(delta)], 3000.0, pixels=pixels, seed=seed
        )
        shares.append(len(np.unique(events.pixel[events.on])) / pixels)
    return np.array(shares)


def events_per_edge(sensor, contrast, *, rising, steps=400):
    """Events of one noiseless pixel while its light changes slowly by a log contrast.

    The light climbs a stair of `steps` steps, 1 ms each, at 100 W/m2 and less: the receptor is at rest at the
    end of each.
    """
    ladder = np.linspace(0, contrast, steps + 1)
    light = 100.0 * np.exp(-contrast) * np.exp(ladder if rising else ladder[::-1])
    edges = np.arange(steps + 1) * 1000.0
    events = pixel_events(sensor, edges, light, float(edges[-1] + 1000))
    return int((events.on == rising).sum())
