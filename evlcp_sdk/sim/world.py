"""Place a scene on earth: its bars as sites, its camera's path as geodetic positions and attitudes.

The axes of a scene are x to the right, y down and z ahead, with its origin at `[world]`, z level and towards
`world.heading_deg`.
"""

import hashlib
import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.scene.attitude import AttitudeLog
from evlcp_sdk.scene.sites import BarSite, LocalAxes
from evlcp_sdk.sim.motion import CameraPath
from evlcp_sdk.sim.scene import BarSpec, Scene, WorldSpec, links_of

Floats = NDArray[np.float64]


def bar_axes(bar: BarSpec) -> Floats:
    """Return the unit vectors to a bar's right, to its bottom and out of its front in the scene's axes."""
    lean, tilt = math.radians(bar.lean_deg), math.radians(bar.tilt_deg)
    right = math.cos(lean), math.sin(lean), 0.0
    down = -math.sin(lean) * math.cos(tilt), math.cos(lean) * math.cos(tilt), -math.sin(tilt)
    return np.stack([right, down, np.cross(down, right)])


def scene_to_enu(vectors: Floats, heading_deg: float) -> Floats:
    """Convert vectors in the scene's axes to east, north, up, float64 (..., 3).

    >>> scene_to_enu(np.array([0.0, -1.0, 10.0]), 90.0).round(6).tolist()
    [10.0, 0.0, 1.0]
    """
    heading = math.radians(heading_deg)
    x, y, z = np.moveaxis(vectors, -1, 0)
    east = x * math.cos(heading) + z * math.sin(heading)
    north = z * math.cos(heading) - x * math.sin(heading)
    return np.stack([east, north, -y], -1)


def sites_of(scene: Scene, registry: Registry | None = None) -> tuple[BarSite, ...]:
    """Return the bars of a scene as sites; the first bar is transmitter 1 unless it has an id.

    Raises:
        ConfigError: The scene has no `[world]`, or a bar's link is not valid.
    """
    world, axes = _require_world(scene)
    sites = []
    for i, (bar, link) in enumerate(zip(scene.bars, links_of(scene, registry), strict=True)):
        latitude, longitude, height = axes.to_geodetic(
            scene_to_enu(np.array([bar.x_m, bar.y_m, bar.z_m]), world.heading_deg)
        )
        _, down, front = scene_to_enu(bar_axes(bar), world.heading_deg)
        east, north, _ = front
        facing = math.degrees(math.atan2(east, north)) % 360
        east, north, up = -down
        level = math.hypot(east, north)
        # A vertical bar has no heading.
        heading = math.degrees(math.atan2(east, north)) % 360 if level > 1e-9 else 0.0
        sites.append(
            BarSite(
                transmitter_id=i + 1 if bar.transmitter_id is None else bar.transmitter_id,
                latitude_deg=float(latitude),
                longitude_deg=float(longitude),
                height_m=float(height),
                heading_deg=heading,
                tilt_deg=math.degrees(math.atan2(level, up)),
                length_m=link.bar.length_m,
                position_sigma_m=0.0,
                facing_deg=None if link.bar.is_even_line else facing,
            )
        )
    return tuple(sites)


def survey_sites(scene: Scene, seed: int, registry: Registry | None = None) -> tuple[BarSite, ...]:
    """Return the sites of the bars as a survey reports them, with its errors, known and unknown.

    Raises:
        ConfigError: The scene has no `[world]`, or a bar's link is not valid.
    """
    world, axes = _require_world(scene)
    true = sites_of(scene, registry)
    errors = _make_rng(scene, seed, 0x517E).normal(size=(len(true), 3)) * world.survey_sigma_m
    surveyed = []
    for i, (bar, site) in enumerate(zip(scene.bars, true, strict=True)):
        there = true[i if bar.site_of is None else bar.site_of]
        off = np.array(bar.site_off_m) + errors[i]
        place: dict[str, Any] = {}
        if off.any():
            enu = axes.to_enu(there.latitude_deg, there.longitude_deg, there.height_m) + off
            keys = ("latitude_deg", "longitude_deg", "height_m")
            place = dict(zip(keys, map(float, axes.to_geodetic(enu)), strict=True))
        surveyed.append(
            replace(there, transmitter_id=site.transmitter_id, position_sigma_m=world.survey_sigma_m, **place)
        )
    return tuple(surveyed)


def drop_reported_errors(scene: Scene) -> Scene:
    """Return the scene without errors of reported sites and attitudes, which do not change its rendering."""
    bars = tuple(replace(bar, site_off_m=(0.0, 0.0, 0.0), site_of=None) for bar in scene.bars)
    world = scene.world
    if world is not None:
        world = WorldSpec(world.latitude_deg, world.longitude_deg, world.height_m, world.heading_deg)
    return replace(scene, bars=bars, world=world)


def locate_camera(scene: Scene, position_m: Floats, attitude_rad: Floats) -> dict[str, Any]:
    """Return geodetic positions and attitudes of the camera as lists, one entry a time.

    The keys are latitude_deg, longitude_deg, height_m; heading_deg clockwise from north, pitch_deg up,
    roll_deg with the camera's top to the right. Positions and (yaw, pitch, roll), float64 (n, 3), are in the
    scene's axes.

    Raises:
        ConfigError: The scene has no `[world]`.
    """
    world, axes = _require_world(scene)
    latitude, longitude, height = axes.to_geodetic(scene_to_enu(position_m, world.heading_deg))
    yaw, pitch, roll = np.degrees(attitude_rad).T
    # 1e-9 degrees are 0.1 mm.
    return {
        "latitude_deg": [round(float(v), 10) for v in latitude],
        "longitude_deg": [round(float(v), 10) for v in longitude],
        "height_m": [round(float(v), 5) for v in height],
        "heading_deg": [round(float(v), 5) for v in (world.heading_deg + yaw) % 360],
        "pitch_deg": [round(float(v), 5) for v in pitch],
        "roll_deg": [round(float(v), 5) for v in roll],
    }


def attitude_log(scene: Scene, seed: int, path: CameraPath) -> AttitudeLog | None:
    """Return an IMU's log of the camera's attitude, every millisecond, None if `world.attitude` is "none".

    Its errors are constant over a recording, and it may have faults it is not aware of.

    Raises:
        ConfigError: The scene has no `[world]`.
    """
    world, _ = _require_world(scene)
    if world.attitude == "none":
        return None
    t_us = np.append(np.arange(0.0, scene.duration_s * 1e6, 1000.0), scene.duration_s * 1e6)
    yaw, pitch, roll = np.degrees(path.sample(np.maximum(t_us - world.attitude_late_ms * 1e3, 0.0))[1]).T
    sigmas = np.array([world.gravity_sigma_deg, world.gravity_sigma_deg, world.heading_sigma_deg])
    off = _make_rng(scene, seed, 0xA77).normal(size=3) * world.attitude_errs * sigmas + world.attitude_off_deg
    return AttitudeLog(
        t_us + scene.t0_us,
        pitch + off[0],
        roll + off[1],
        world.heading_deg + yaw + off[2] if world.attitude == "heading" else None,
        np.full(len(t_us), world.gravity_sigma_deg),
        np.full(len(t_us), world.heading_sigma_deg),
    )


def _make_rng(scene: Scene, seed: int, purpose: int) -> np.random.Generator:
    """Make the generator of a recording, seeded by where its camera and bars are.

    Reported errors do not change the seed, so that a fault is compared with the same drive without it.
    """
    motion = replace(scene.motion, path_file=None)
    bars = [(bar.x_m, bar.y_m, bar.z_m, bar.lean_deg, bar.tilt_deg) for bar in scene.bars]
    digest = hashlib.sha256(repr((motion, bars)).encode()).digest()
    return np.random.default_rng([seed, purpose, int.from_bytes(digest[:8])])


def _require_world(scene: Scene) -> tuple[WorldSpec, LocalAxes]:
    world = scene.world
    if world is None:
        raise ConfigError("the scene has no [world]: nothing says where on earth it is")
    return world, LocalAxes(world.latitude_deg, world.longitude_deg, world.height_m)
