"""What a simulation leaves beside its recording: the truth."""

from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.sim.light import BarLight, reflections_of
from evlcp_sdk.sim.motion import project
from evlcp_sdk.sim.optics import blur_sigma_px
from evlcp_sdk.sim.scene import Scene
from evlcp_sdk.sim.simulation import Simulation
from evlcp_sdk.sim.truth import Truth, truth_from_table
from evlcp_sdk.sim.world import camera_on_earth, sites_of

Floats = NDArray[np.float64]

OF_SENSOR = (
    *("noise_hz", "refr_us", "th_on", "th_off", "noise_ln", "p_on_miss", "p_off_miss"),
    *("dly_on_us", "dly_off_us", "jitter_us", "tau_sf_us", "t_row_us", "cap_mev_s"),
)
"""Of the sensor's parameters, those that the truth repeats."""


def truth_of(
    simulated: Simulation | Scene, seed: int | None = None, registry: Registry | None = None
) -> Truth:
    """The truth of a simulation, with the counts when it has run; or of a scene without rendering it.

    Of its table, `scene` holds the scene's parameters; `psf_sigma_px` and `e_led` the blur and the light of
    each bar; `others` the reflections: of which bar (`src`), how bright beside it (`gain`) and where in the
    image; `simulator` the resolved scene, which renders the recording again. Bars, reflections and camera are
    sampled every millisecond.

    Args:
        simulated: The simulation, or the scene.
        seed: Instead of the scene's.
        registry: Where the algorithms of its links are found; None for all that are installed.

    Raises:
        ConfigError: The scene cannot be rendered.
        InputError: One of its files cannot be read.
    """
    simulation = (
        simulated if isinstance(simulated, Simulation) else Simulation(simulated, seed, registry=registry)
    )
    scene = simulation.scene
    camera = scene.camera
    t_s = np.arange(max(1, round(scene.duration_s * 1000))) / 1000
    position, attitude = simulation.path.at(t_s * 1e6)
    centres = np.array([b.centre_m for b in simulation.bars]).reshape(-1, 3)
    place, depth = project(centres, position, attitude, camera)
    found: dict[str, Any] = {
        "scene": _scene_of(simulation),
        "bars": [_bar_of(light, scene.duration_s) for light in simulation.bars],
        "others": _others(simulation, position, attitude),
        "camera": _named(camera, "focal_mm", "pitch_um", "width", "height")
        | dict(zip(("cx", "cy"), camera.centre_px, strict=True)),
        "t_s": t_s.tolist(),
        "distance_m": _rounded(depth.T, 5),
        "bar_centre_px": [_rounded(bar, 3) for bar in place.transpose(1, 2, 0)],
        "camera_path": {
            "position_m": _rounded(position.T, 5),
            "attitude_deg": _rounded(np.degrees(attitude).T, 5),
        },
        "psf_sigma_px": [blur_sigma_px(float(d), scene.lens, camera) for d in depth[0]],
        "e_led": [light.light_w_m2 for light in simulation.bars],
        "simulator": asdict(scene),
    }
    if scene.world is not None:
        found["sites"] = [asdict(site) for site in sites_of(scene, registry)]
        found["camera_path"] |= camera_on_earth(scene, position, attitude)
    if simulation.done_s:
        found |= simulation.counts
    return truth_from_table(found, links={light.link.digest: light.link for light in simulation.bars})


def _rounded(rows: Floats, digits: int) -> list[list[float]]:
    return [[round(value, digits) for value in row] for row in rows.tolist()]


def _named(given: object, *names: str) -> dict[str, Any]:
    """Some of a description's values, by name."""
    return {name: getattr(given, name) for name in names}


def _bar_of(light: BarLight, duration_s: float) -> dict[str, Any]:
    """What the truth says of a bar and of what it sends."""
    bar = light.bar
    found = {
        **_named(bar, "x_m", "y_m", "z_m", "width_m", "ppm", "led_w_m2", "chips_file", "payload"),
        "length_m": light.link.bar.length_m,
        "link": light.link.digest,
        "seed": light.payload_seed,
        "start_chip": light.start_chip,
        "symbols": light.sent_symbols(duration_s),
        "covered": sorted({*bar.covered, *light.dark}),
        "cover_s": [list(span) for span in bar.cover_s],
        "pole_s": [list(span) for span in bar.pole_s],
    }
    return found if bar.chips_file is None else found | {"packet_chips": light.packet_chips}


def _scene_of(simulation: Simulation) -> dict[str, Any]:
    """The parameters of a scene."""
    scene = simulation.scene
    return {
        **_named(scene, "name", "duration_s", "seed", "flicker_lamps", "t0_us"),
        **_named(scene.motion, "distance_m", "speed_mps", "vib_rate_rad_s"),
        **_named(scene.lens, "focus_m", "f_number", "halo"),
        **_named(scene.sensor, *OF_SENSOR),
        "background_w_m2": scene.background.light_w_m2,
        "background_texture": scene.background.texture,
        "hot_pixels": simulation.hot_pixels,
        "hpf_us": 0.0,
        **_of_a_road(scene),
    }


def _of_a_road(scene: Scene) -> dict[str, Any]:
    """What a scene's table says of bloom, wiper and potholes, where there are any."""
    found: dict[str, Any] = {}
    lens, motion, wiper = scene.lens, scene.motion, scene.wiper
    if lens.bloom > 0:
        found |= {"bloom": lens.bloom, "bloom_px": lens.bloom_px}
    if wiper.share > 0:
        found["wiper"] = [wiper.at_s, wiper.lasts_s, wiper.share]
    if motion.pothole_s:
        found["pothole_px_ms"] = motion.pothole_rad_s * scene.camera.focal_px / 1000
        found["pothole_s"] = motion.pothole_s[0]
        found["pothole_hz"] = motion.pothole_hz
    return found


def _others(simulation: Simulation, position: Floats, attitude: Floats) -> list[dict[str, Any]]:
    """The reflections of all bars, each with the places of its centre, px."""
    found = []
    for i, light in enumerate(simulation.bars):
        columns = len(light.strips)
        for j, reflection in enumerate(reflections_of(simulation.scene, i)):
            images = light.images[j * columns : (j + 1) * columns]
            # The middle of the columns' middles is the bar's.
            strips = [replace(image, strip=replace(image.strip, cuts=(-0.5, 0.0, 0.5))) for image in images]
            place = np.mean([simulation.seen(strip, position, attitude)[0][:, 1] for strip in strips], 0)
            kind = "mirror" if reflection.kind == "road" else "ghost"
            one = {"kind": kind, "src": i, "gain": reflection.share, "centre_px": _rounded(place.T, 3)}
            found.append(one)
    return found
