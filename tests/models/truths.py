"""Truths of another generator, with the keys of ours: scenes that our simulator renders in their place."""

import math

from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.sim import resolve_scene, truth_from_table
from evlcp_sdk.sim.record import SENSOR_KEYS


def scene_of_truth(truth):
    """The scene of a recording, from its truth: the same bars, symbols, light and sensor; another vibration.

    Everything is taken over that both know: covers, wiper, bloom, potholes, mirror images, ghost images and
    panels among it. Lamps at random places are as many, but at other places.
    """
    sent, given, camera = truth_from_table(truth).bars, truth["scene"], truth["camera"]
    optics = {key: camera[key] for key in ("width", "height", "focal_mm", "pitch_um")}
    focal_px = CameraModel(**optics).focal_px
    table = {
        **_take_keys(given, ("name", "duration_s", "t0_us", "seed", "flicker_lamps")),
        "camera": optics,
        # Its blur is stated as one sigma: a Gaussian without wings.
        "lens": {**_take_keys(given, ("f_number", "focus_m", "halo"), ("bloom", "bloom_px")), "wings": False},
        "motion": _motion_of(given, focal_px),
        "background": {
            "light_w_m2": given["background_w_m2"],
            "texture": given["background_texture"],
            **_take_keys(given, (), ("texture_px",)),
            # How far around the bar such recordings have events of a background that moves.
            **({"around_px": 24, "texture_step_px": 0.4} if given.get("bg_moves") else {}),
            **({"around_px": 60, "change_s": given["bg_steps"]} if given.get("bg_steps") else {}),
        },
        "drops": [
            # Theirs is that of a slope at the middle, of which the rim bends this share.
            {
                "x_px": x,
                "y_px": y,
                "speed_px_s": [right, down],
                "radius_px": radius,
                "bend_px": bend / math.sqrt(math.e),
            }
            for x, y, right, down, radius, bend in given.get("drops", ())
        ],
        "sensor": {
            **_take_keys(given, SENSOR_KEYS),
            "hot_share": given["hot_pixels"] / (camera["width"] * camera["height"]),
        },
        "bars": [_bar_spec_of(*both, given) for both in zip(truth["bars"], sent, strict=True)],
        **_others_of(truth, given["distance_m"] / focal_px),
    }
    if given.get("wiper"):
        table["wiper"] = dict(zip(("at_s", "lasts_s", "share"), given["wiper"], strict=True), edge_s=0.0)
    return resolve_scene(table, source="truth")


def _take_keys(given, keys, optional=()):
    """Values under keys that a scene has, too; the optional ones where they are."""
    return {key: given[key] for key in (*keys, *(key for key in optional if key in given))}


def _bar_spec_of(bar, sent, given):
    """A bar's table of a scene, from its row of the truth and what that means."""
    found = _take_keys(
        bar,
        ("x_m", "y_m", "z_m", "width_m", "ppm", "led_w_m2", "start_chip"),
        ("chips_file", "lean_deg", "tilt_deg", "covered", "cover_s", "pole_s", "dead_leds", "led_spread"),
    )
    found["link"] = {section: dict(keys) for section, keys in sent.link.table.items()}
    if given.get("led_w_m2_all"):
        found["led_w_m2"] = given["led_w_m2_all"]
    if bar["symbols"]:
        found["symbols"] = bar["symbols"]
    return found


def _motion_of(given, focal_px):
    """What a scene's table says of the camera's motion, as keys of `[motion]`."""
    found = _take_keys(given, ("distance_m", "speed_mps", "vib_rate_rad_s"), ("lateral_mps",))
    names = {
        "cam_yaw_deg": "yaw_deg",
        "cam_pitch_deg": "pitch_deg",
        "cam_roll_deg": "roll_deg",
        "yaw_share": "vib_yaw_share",
    }
    found |= {ours: given[theirs] for theirs, ours in names.items() if theirs in given}
    if given.get("yaw_rate_deg_s"):
        # There it turns to the left, and looks along `cam_yaw_deg` half-way.
        found["yaw_rate_deg_s"] = -given["yaw_rate_deg_s"]
        found["yaw_deg"] += given["yaw_rate_deg_s"] * given["duration_s"] / 2
    if given.get("pothole_px_ms"):
        found["pothole_s"] = [given["pothole_s"]]
        found["pothole_rad_s"] = given["pothole_px_ms"] * 1000 / focal_px
        found["pothole_hz"] = given["pothole_hz"]
    return found


def _others_of(truth, m_per_px):
    """What another generator's truth says of mirror images, ghost images and panels."""
    camera = truth["camera"]
    reflections, lamps = [], []
    for other in truth.get("others", []):
        kind = other["kind"]
        if kind == "pwm":
            lamps.append(
                {
                    "x_m": (other["u_px"] - camera["cx"]) * m_per_px,
                    "y_m": (other["v_px"] - camera["cy"]) * m_per_px,
                    "width_m": other["w_px"] * m_per_px,
                    "height_m": other["h_px"] * m_per_px,
                    "light_w_m2": other["led_w_m2"],
                    "flicker_hz": other["pwm_hz"],
                    "duty": other["duty"],
                }
            )
            continue
        bar = truth["bars"][other["src"]]
        one = {"bar": other["src"], "share": other["gain"]}
        if kind == "mirror":
            low = bar["y_m"] + bar["length_m"] / 2
            sigma = truth["psf_sigma_px"][other["src"]]
            one |= {
                "kind": "road",
                "gap_m": 2 * (other["road_y_m"] - low),
                "blur_px": sigma * math.sqrt(other["streak"] ** 2 - 1),
            }
        else:
            one |= {"kind": "window", "shift_px": [other["dx_px"], other["dy_px"]]}
        reflections.append(one)
    return {"reflections": reflections, "lamps": lamps}
