"""What a simulation leaves beside its recording: the truth, and the scene that a truth describes."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from evlcp_sdk.errors import ConfigError, InputError
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.sim.motion import project
from evlcp_sdk.sim.optics import blur_sigma_px
from evlcp_sdk.sim.scene import Scene, resolve_scene
from evlcp_sdk.sim.simulation import Simulation, scene_table
from evlcp_sdk.sim.truth import Truth, link_table_of, truth_from_table
from evlcp_sdk.sim.world import camera_on_earth, sites_of

__all__ = ["scene_of_truth", "truth_of"]


def truth_of(
    simulated: Simulation | Scene, seed: int | None = None, registry: Registry | None = None
) -> Truth:
    """The truth of a simulation, with the counts when it has run; or of a scene without rendering it.

    Of its table, `scene` holds the scene's parameters; `psf_sigma_px` and `e_led` the blur and the light of
    each bar; `simulator` the resolved scene, which renders the recording again. Bars and camera are sampled
    every millisecond.

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
    camera, sensor, motion = scene.camera, scene.sensor, scene.motion
    t_s = np.arange(max(1, round(scene.duration_s * 1000))) / 1000
    position, attitude = simulation.path.at(t_s * 1e6)
    centres = np.array([b.centre_m for b in simulation.bars]).reshape(-1, 3)
    place, depth = project(centres, position, attitude, camera)
    bars = []
    for light in simulation.bars:
        bar = light.bar
        bars.append(
            {
                "x_m": bar.x_m,
                "y_m": bar.y_m,
                "z_m": bar.z_m,
                "length_m": light.link.bar.length_m,
                "width_m": bar.width_m,
                "link": light.link.digest,
                "seed": light.payload_seed,
                "ppm": bar.ppm,
                "start_chip": light.start_chip,
                "led_w_m2": bar.led_w_m2,
                "chips_file": bar.chips_file,
                "payload": bar.payload,
                "symbols": light.sent_symbols(scene.duration_s),
                **({"packet_chips": light.packet_chips} if bar.chips_file is not None else {}),
            }
        )
    found: dict[str, Any] = {
        "scene": {
            "name": scene.name,
            "duration_s": scene.duration_s,
            "distance_m": motion.distance_m,
            "speed_mps": motion.speed_mps,
            "vib_rate_rad_s": motion.vib_rate_rad_s,
            "background_w_m2": scene.background.light_w_m2,
            "background_texture": scene.background.texture,
            "noise_hz": sensor.noise_hz,
            "hot_pixels": simulation.hot_pixels,
            "focus_m": scene.lens.focus_m,
            "f_number": scene.lens.f_number,
            "refr_us": sensor.refr_us,
            "th_on": sensor.th_on,
            "th_off": sensor.th_off,
            "noise_ln": sensor.noise_ln,
            "p_on_miss": sensor.p_on_miss,
            "p_off_miss": sensor.p_off_miss,
            "dly_on_us": sensor.dly_on_us,
            "dly_off_us": sensor.dly_off_us,
            "jitter_us": sensor.jitter_us,
            "tau_sf_us": sensor.tau_sf_us,
            "hpf_us": 0.0,
            "t_row_us": sensor.t_row_us,
            "cap_mev_s": sensor.cap_mev_s,
            "halo": scene.lens.halo,
            "seed": scene.seed,
            "flicker_lamps": scene.flicker_lamps,
            "t0_us": scene.t0_us,
        },
        "bars": bars,
        "camera": {
            "focal_mm": camera.focal_mm,
            "pitch_um": camera.pitch_um,
            "width": camera.width,
            "height": camera.height,
            "cx": camera.centre_px[0],
            "cy": camera.centre_px[1],
        },
        "t_s": [round(float(t), 3) for t in t_s],
        "distance_m": [[round(float(v), 5) for v in column] for column in depth.T],
        "bar_centre_px": [
            [[round(float(v), 3) for v in place[:, i, axis]] for axis in (0, 1)] for i in range(len(bars))
        ],
        "camera_path": {
            "position_m": [[round(float(v), 5) for v in axis] for axis in position.T],
            "attitude_deg": [[round(float(v), 5) for v in axis] for axis in np.degrees(attitude).T],
        },
        "psf_sigma_px": [blur_sigma_px(float(d), scene.lens, camera) for d in depth[0]],
        "e_led": [light.light_w_m2 for light in simulation.bars],
        "simulator": scene_table(scene),
    }
    if scene.world is not None:
        found["sites"] = [asdict(site) for site in sites_of(scene, registry)]
        found["camera_path"] |= camera_on_earth(scene, position, attitude)
    if simulation.done_s:
        found |= simulation.counts
    return truth_from_table(found, links={light.link.digest: light.link for light in simulation.bars})


def scene_of_truth(truth: Truth | Mapping[str, Any]) -> Scene:
    """The scene of a recording, from its truth: the same bars, symbols, light and sensor; another vibration.

    A truth written here gives exactly its scene. Of another generator's, with the same keys, everything is
    taken over that both know; lamps are as many, but at other places.

    Raises:
        ConfigError: Keys are missing, or ask for what is not modelled (`hpf_us`).
    """
    if isinstance(truth, Truth):
        truth = truth.to_table()
    if "simulator" in truth:
        return resolve_scene(truth["simulator"], source="truth")
    try:
        told, camera = truth["scene"], truth["camera"]
        if told["hpf_us"] != 0:
            raise ConfigError(f"truth: scene.hpf_us = {told['hpf_us']}: a high-pass filter is not modelled")
        same = (
            *(
                "th_on",
                "th_off",
                "noise_ln",
                "noise_hz",
                "p_on_miss",
                "p_off_miss",
                "dly_on_us",
                "dly_off_us",
            ),
            *("jitter_us", "tau_sf_us", "refr_us", "t_row_us", "cap_mev_s"),
        )
        shape = (
            "x_m",
            "y_m",
            "z_m",
            "width_m",
            "ppm",
            "led_w_m2",
        )
        pixels = camera["width"] * camera["height"]
        table = {
            "name": told["name"],
            "duration_s": told["duration_s"],
            "t0_us": told["t0_us"],
            "seed": told["seed"],
            "flicker_lamps": told["flicker_lamps"],
            "camera": {key: camera[key] for key in ("width", "height", "focal_mm", "pitch_um")},
            "lens": {key: told[key] for key in ("f_number", "focus_m", "halo")},
            "motion": {key: told[key] for key in ("distance_m", "speed_mps", "vib_rate_rad_s")},
            "background": {
                "light_w_m2": told["background_w_m2"],
                "texture": told["background_texture"],
            },
            "sensor": {key: told[key] for key in same} | {"hot_share": told["hot_pixels"] / pixels},
            "bars": [
                {key: bar[key] for key in (*shape, "start_chip", "chips_file")}
                | {"link": _link_table(truth, bar, f"bars.{i}")}
                | ({"symbols": bar["symbols"]} if bar["symbols"] else {})
                for i, bar in enumerate(truth["bars"])
            ],
        }
    except (KeyError, TypeError) as fault:
        raise ConfigError(f"truth: not a scene's truth: {fault}") from fault
    except InputError as fault:
        raise ConfigError(str(fault)) from fault
    return resolve_scene(table, source="truth")


def _link_table(truth: Mapping[str, Any], bar: Mapping[str, Any], where: str) -> Any:
    """The table of a bar's link, which it names, or which follows from what it says of its frames."""
    if bar.get("link") is None:
        return link_table_of(bar, "truth", where)
    return truth["links"][bar["link"]]["table"]
