"""Compile the truth of a simulation."""

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
from evlcp_sdk.sim.world import locate_camera, sites_of

Floats = NDArray[np.float64]

SENSOR_KEYS = (
    *("noise_hz", "refr_us", "th_on", "th_off", "noise_ln", "p_on_miss", "p_off_miss"),
    *("dly_on_us", "dly_off_us", "jitter_us", "tau_sf_us", "t_row_us", "cap_mev_s"),
)
"""Parameters of the sensor that the truth repeats."""


def truth_of(
    simulated: Simulation | Scene, seed: int | None = None, registry: Registry | None = None
) -> Truth:
    """Return the truth of a simulation, with the counts if it has run; or of a scene, without rendering it.

    In its table, `scene` has the scene's parameters; `links` the bars' links by digest; `psf_sigma_px` and
    `e_led` the blur and the light of each bar; `others` the reflections: of which bar (`src`), how bright
    relative to it (`gain`) and where in the image; `simulator` the resolved scene, which renders the
    recording again. Bars, reflections and camera are sampled every millisecond. A `seed` replaces the
    scene's.

    Raises:
        ConfigError: The scene cannot be rendered.
        InputError: One of its files cannot be read.
    """
    simulation = (
        simulated if isinstance(simulated, Simulation) else Simulation(simulated, seed, registry=registry)
    )
    scene = simulation.scene
    camera = scene.camera
    links = {light.link.digest: light.link for light in simulation.bars}
    t_s = np.arange(max(1, round(scene.duration_s * 1000))) / 1000
    position, attitude = simulation.path.sample(t_s * 1e6)
    centres = np.array([b.centre_m for b in simulation.bars]).reshape(-1, 3)
    place, depth = project(centres, position, attitude, camera)
    found: dict[str, Any] = {
        "scene": _describe_scene(simulation),
        "bars": [_describe_bar(light, scene.duration_s) for light in simulation.bars],
        "links": {
            digest: {"table": link.table, "codebook": link.codebook.digest, "revisions": link.revisions}
            for digest, link in links.items()
        },
        "others": _locate_reflections(simulation, position, attitude),
        "camera": _pick_fields(camera, "focal_mm", "pitch_um", "width", "height")
        | dict(zip(("cx", "cy"), camera.centre_px, strict=True)),
        "t_s": t_s.tolist(),
        "distance_m": _round_rows(depth.T, 5),
        "bar_centre_px": [_round_rows(bar, 3) for bar in place.transpose(1, 2, 0)],
        "camera_path": {
            "position_m": _round_rows(position.T, 5),
            "attitude_deg": _round_rows(np.degrees(attitude).T, 5),
        },
        "psf_sigma_px": [blur_sigma_px(float(d), scene.lens, camera) for d in depth[0]],
        "e_led": [light.light_w_m2 for light in simulation.bars],
        "simulator": asdict(scene),
    }
    if scene.world is not None:
        found["sites"] = [asdict(site) for site in sites_of(scene, registry)]
        found["camera_path"] |= locate_camera(scene, position, attitude)
    if simulation.done_s:
        found |= simulation.counts
    return truth_from_table(found, links=links)


def _round_rows(rows: Floats, digits: int) -> list[list[float]]:
    return [[round(value, digits) for value in row] for row in rows.tolist()]


def _pick_fields(description: object, *names: str) -> dict[str, Any]:
    return {name: getattr(description, name) for name in names}


def _describe_bar(light: BarLight, duration_s: float) -> dict[str, Any]:
    """A bar's values; the number of clusters and the like, which its link has, are for other readers."""
    bar, link = light.bar, light.link
    hidden: dict[str, Any] = {
        "covered": sorted({*bar.covered, *light.dark}),
        "cover_s": [list(span) for span in bar.cover_s],
        "pole_s": [list(span) for span in bar.pole_s],
    }
    return {
        "link": link.digest,
        "profile": link.codebook.profile,
        "clusters": link.codebook.clusters,
        **_pick_fields(link.packet, "frames", "pilot_every"),
        "packet_chips": light.packet_chips,
        **_pick_fields(bar, "x_m", "y_m", "z_m", "width_m", "ppm", "led_w_m2", "chips_file", "payload"),
        "length_m": link.bar.length_m,
        "seed": light.payload_seed,
        "start_chip": light.start_chip,
        "symbols": light.list_symbols(duration_s),
        **{key: values for key, values in hidden.items() if values},
    }


def _describe_scene(simulation: Simulation) -> dict[str, Any]:
    scene = simulation.scene
    return {
        **_pick_fields(scene, "name", "duration_s", "seed", "flicker_lamps", "t0_us"),
        **_pick_fields(scene.motion, "distance_m", "speed_mps", "vib_rate_rad_s"),
        **_pick_fields(scene.lens, "focus_m", "f_number", "halo"),
        **_pick_fields(scene.sensor, *SENSOR_KEYS),
        "background_w_m2": scene.background.light_w_m2,
        "background_texture": scene.background.texture,
        "hot_pixels": simulation.hot_pixels,
        "hpf_us": 0.0,
        **_describe_road(scene),
    }


def _describe_road(scene: Scene) -> dict[str, Any]:
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


def _locate_reflections(simulation: Simulation, position: Floats, attitude: Floats) -> list[dict[str, Any]]:
    found = []
    for i, light in enumerate(simulation.bars):
        columns = len(light.strips)
        for j, reflection in enumerate(reflections_of(simulation.scene, i)):
            images = light.images[j * columns : (j + 1) * columns]
            # The centre of a bar is the mean of its columns' centres.
            strips = [replace(image, cuts=(-0.5, 0.0, 0.5)) for image in images]
            place = np.mean(
                [simulation.project_source(strip, position, attitude)[0][:, 1] for strip in strips], 0
            )
            kind = "mirror" if reflection.kind == "road" else "ghost"
            centre_px = _round_rows(place.T, 3)
            found.append({"kind": kind, "src": i, "gain": reflection.share, "centre_px": centre_px})
    return found
