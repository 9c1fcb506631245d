"""What positions promise, by Monte Carlo: covariances, fixes kept, faults found, protection levels.

    python benchmarks/integrity.py               # the figures of docs/position.md: 100 000 fixes, minutes
    python benchmarks/integrity.py --fixes 200   # of a row
    python benchmarks/integrity.py --bar-fault 0.5   # levels against bars off by half a metre (sigma)
    python benchmarks/integrity.py --floor       # what no test can find, in closed form: minutes
    python benchmarks/integrity.py --speed       # time of a fix, one after the other, the best of six rounds
    python benchmarks/integrity.py --track       # the same covariances over drives, filtered and smoothed

Bars stand 30 to 90 m ahead, anywhere in view. Every error is drawn from its stated sigma: of points, of what
a bar's points share, of survey, camera and attitude; then one part is made wrong without anybody's
knowledge. A row:

- NEES: mean of e' P^-1 e, 3 where covariances are right; its 99.73 % bound is 14.2
- kept: fixes given, of those that the geometry allows
- silent: fixes given whose error is beyond the 99.73 % bound of their own covariance, of the same; with an
  exact covariance chance alone makes it .0027 of those given
- beyond chance: silent fixes less those; its standard error is .001 at 2900 fixes
- not covered: silent fixes that have no protection level, and say so by an alarm, or are beyond it
- left out: fixes given without a part that is named
- protected: fixes with both protection levels; their medians; and the share beyond one of them
"""

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special
from scipy.spatial.transform import Rotation

from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.fit_assessment import Pose
from evlcp_sdk.place.observations import BarView, Rejection, project_bars
from evlcp_sdk.place.pose import solve_pose
from evlcp_sdk.place.trajectory import filter_fixes, smooth_trajectory
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.camera import CameraModel, CameraSigma
from evlcp_sdk.study.tally import SILENT_NEES
from evlcp_sdk.values import Fix

Floats = NDArray[np.float64]

CAMERA = CameraModel()
SPEC = ErrorModel()
NOISE_PX = 0.05
PIXEL_PX = 0.05
POINT_PX = math.hypot(NOISE_PX, PIXEL_PX)
"""Of a point along its bar: new with every fix, what stands until the image has moved, and both."""
ACROSS = 0.6
"""Errors across a bar in those along it, as of simulated drives by night."""
ALONG = (0.5 - (np.arange(16) + 0.5) / 16) * 0.96
WRONG_FOCAL = 0.005
"""By what share a focal length is wrong that is."""

CHANCE = 0.0027
"""What is beyond it by chance. For .001, covariances are 16.27 / 14.16 times as large, and NEES is 2.6."""


@dataclass(frozen=True)
class World:
    """What is seen, and how precisely everything is known.

    Attributes:
        bars: How many.
        attitude: What is known of the attitude: "none", "gravity" or "heading".
        survey: Sigmas of each bar's place, m, turn, radians, and length, a share.
        focal: Of the focal length, as a share.
        attitude_deg: Of pitch, roll and heading each.
    """

    bars: int
    attitude: str
    survey: tuple[float, float, float] = (0.0, 0.0, 0.0)
    focal: float = 0.0
    attitude_deg: float = 0.1


@dataclass
class Scene:
    """What the solver is given, which a fault changes, and where the camera is (the origin)."""

    views: list[BarView]
    attitude: Attitude | None
    camera: CameraModel
    sigma: CameraSigma
    rotation: Floats


def own_shift(points_px: Floats, spec: ErrorModel) -> Floats:
    """A root of the covariance of the shift that a bar's points share, px^2, float64 (2, 2)."""
    whole = points_px[-1] - points_px[0]
    length_px = float(np.linalg.norm(whole))
    along = whole / length_px
    longways = math.hypot(spec.shared_along_px, spec.shared_share * length_px * 16 / 15)
    return spec.shared_sigma_px * np.eye(2) + (longways - spec.shared_sigma_px) * np.outer(along, along)


def across_scale(points_px: Floats) -> Floats:
    """What makes even errors of points `ACROSS` as large across the bar, float64 (2, 2)."""
    along = points_px[-1] - points_px[0]
    along = along / np.linalg.norm(along)
    return ACROSS * np.eye(2) + (1 - ACROSS) * np.outer(along, along)


def measured_attitude(world: World, pitch_deg: float, roll_deg: float, heading_deg: float) -> Attitude | None:
    """What is known of an attitude, of which this is measured."""
    if world.attitude == "none":
        return None
    heading = heading_deg if world.attitude == "heading" else None
    return Attitude(pitch_deg, roll_deg, heading, world.attitude_deg, world.attitude_deg)


def scene(world: World, rng: np.random.Generator) -> Scene:
    """A scene with errors of the sigmas that are stated."""
    pitch, roll, heading = rng.uniform(0, 6), rng.normal(0, 1), rng.uniform(0, 360)
    rotation = Attitude(pitch, roll, heading).rotation()
    focal_mm = CAMERA.focal_mm * (1 + world.focal * rng.normal())
    true = replace(CAMERA, focal_mm=focal_mm)
    depth = rng.uniform(30, 90)
    views, vibration_px = [], rng.normal(0, SPEC.vibration_sigma_px, 2)
    # Thirds of the image's width, so that no two bars cover each other.
    slots = rng.permutation(3)[: world.bars]
    for number, slot in enumerate(slots):
        far = depth * rng.uniform(0.8, 1.0)
        ray = np.array([(slot - 1) * 0.055 + rng.uniform(-0.02, 0.02), rng.uniform(-0.025, 0.025), 1.0])
        tilt = rng.normal(0, 0.02, 2)
        axis = np.array([*tilt, 1.0]) / math.sqrt(1 + tilt @ tilt)
        stands = rotation @ (ray * far) + ALONG[:, None] * axis
        points, _ = project_bars(stands, np.zeros(3), rotation, true)
        shift = own_shift(points, SPEC) @ rng.normal(size=2)
        points = points + rng.normal(0, POINT_PX, points.shape) @ across_scale(points) + shift + vibration_px
        place, turn, length = world.survey
        arm = stands - stands.mean(0)
        stated = stands + rng.normal(0, place, 3) + np.cross(rng.normal(0, turn, 3), arm)
        stated = stated + rng.normal(0, math.hypot(length, SPEC.stretch_share)) * arm
        sigma_px = np.full(16, POINT_PX)
        views.append(BarView(number, stated, points, sigma_px, world.survey, PIXEL_PX, across=ACROSS))
    off = rng.normal(0, world.attitude_deg, 3)
    attitude = measured_attitude(world, pitch + off[0], roll + off[1], (heading + off[2]) % 360)
    sigma = CameraSigma(focal_mm=world.focal * CAMERA.focal_mm)
    return Scene(views, attitude, CAMERA, sigma, rotation)


Fault = Callable[[Scene, np.random.Generator], None]


def move_bar(bar: Scene, rng: np.random.Generator) -> None:
    """A bar stands half a metre from where its site states, in any direction."""
    i = int(rng.integers(len(bar.views)))
    way = rng.normal(size=3)
    view = bar.views[i]
    bar.views[i] = replace(view, enu_m=view.enu_m + 0.5 * way / np.linalg.norm(way))


def swap_sites(bars: Scene, _rng: np.random.Generator) -> None:
    """The first two sites are exchanged."""
    one, two = bars.views[:2]
    bars.views[:2] = [replace(one, enu_m=two.enu_m), replace(two, enu_m=one.enu_m)]


def change_focal_length(lens: Scene, rng: np.random.Generator) -> None:
    """The focal length is half a percent off."""
    share = 1 + WRONG_FOCAL * rng.choice([-1, 1])
    lens.camera = replace(lens.camera, focal_mm=lens.camera.focal_mm * share)


Off = Callable[[int, np.random.Generator], Floats]
"""By how much as many angles as are known - pitch, roll, heading - are off, degrees, float64 (3,)."""


def turn_one_angle(known: int, rng: np.random.Generator) -> Floats:
    """One of the attitude's angles is off by 1 degree."""
    off = np.zeros(3)
    off[int(rng.integers(known))] = rng.choice([-1.0, 1.0])
    return off


def delay_attitude(_known: int, rng: np.random.Generator) -> Floats:
    """The attitude is 10 ms old: a car's pitch and heading change by up to 20 and 45 degrees a second."""
    return np.asarray(rng.uniform(-1, 1, 3) * np.array([0.2, 0.2, 0.45]))


def turn_attitude(by: Off) -> Fault:
    """The attitude is off."""

    def turn(imu: Scene, rng: np.random.Generator) -> None:
        if (old := imu.attitude) is None:
            return
        off = by(2 if old.heading_deg is None else 3, rng)
        heading = None if old.heading_deg is None else (old.heading_deg + off[2]) % 360
        imu.attitude = replace(
            old, pitch_deg=old.pitch_deg + off[0], roll_deg=old.roll_deg + off[1], heading_deg=heading
        )

    return turn


def point_information(seen: Scene) -> Floats:
    """Information of all points on the camera's place, m, and turn, radians, and on a share of its focal
    length that is wrong, in `WRONG_FOCAL`: float64 (7, 7).

    Written out with every shared error as an unknown of sigma 1, which are then eliminated.
    """
    parts = []
    shared = 4 + 9 * len(seen.views)
    for b, view in enumerate(seen.views):
        points, slope = project_bars(view.enu_m, np.zeros(3), seen.rotation, seen.camera)
        weight = 1 / view.sigma_px[:, None, None]
        arm, by = view.enu_m - view.enu_m.mean(0), -slope[:, :, :3]
        place, turn, length = view.survey_sigmas
        rows = np.zeros((len(points), 2, 6 + shared))
        rows[:, :, :6] = slope
        away = points - np.array(seen.camera.centre_px)
        rows[:, :, 6] = away * WRONG_FOCAL
        rows[:, :, 7] = away * seen.sigma.focal_mm / seen.camera.focal_mm
        rows[:, :, 8:10] = SPEC.vibration_sigma_px * np.eye(2)
        own = rows[:, :, 10 + 9 * b : 19 + 9 * b]
        own[:, :, :2] = own_shift(view.points_px, SPEC)
        own[:, :, 2] = math.hypot(length, SPEC.stretch_share) * np.einsum("nij,nj->ni", by, arm)
        own[:, :, 3:6] = place * by
        own[:, :, 6:] = turn * np.cross(arm[:, None], by)
        parts.append((np.linalg.inv(across_scale(view.points_px)) @ rows * weight).reshape(-1, 6 + shared))
    rows = np.concatenate(parts)
    whole = rows.T @ rows
    whole[7:, 7:] += np.eye(shared - 1)
    return np.asarray(whole[:7, :7] - whole[:7, 7:] @ np.linalg.solve(whole[7:, 7:], whole[7:, :7]))


def floor(seen: Scene, off_deg: Floats | None, world: World, alarms: tuple[float, ...]) -> list[float]:
    """Chances that no test finds what is off, and that the fix is silent, too: at least so much.

    Neyman and Pearson: of all tests with a chance of a false alarm, the one for the very part, sign and size
    that are off finds it most often. What an error does to the residuals is normal with a mean of `much`
    sigmas, and independent of the position's error, which is off by `moved`. Both for each of `alarms`.

    Args:
        seen: What is seen, and stated of the camera.
        off_deg: By how much the angles are off; None: the focal length is, by `WRONG_FOCAL`.
        world: What is known.
        alarms: Chances of a false alarm.
    """
    known = {"none": 0, "gravity": 2, "heading": 3}[world.attitude]
    step, by_turn = 1e-5, np.zeros((known, 6))
    for k, axis in enumerate(np.eye(3) * step):
        one, two = (
            Attitude.of_rotation(Rotation.from_rotvec(way).as_matrix() @ seen.rotation)
            for way in (axis, -axis)
        )
        change = [one.pitch_deg - two.pitch_deg, one.roll_deg - two.roll_deg]
        change.append(((one.heading_deg or 0) - (two.heading_deg or 0) + 180) % 360 - 180)
        by_turn[:, 3 + k] = np.radians(change)[:known] / (2 * step) / math.radians(world.attitude_deg)
    points = point_information(seen)
    spread = np.linalg.inv(points[:6, :6] + by_turn.T @ by_turn)
    if off_deg is None:
        follow = spread @ points[:6, 6]
        much = math.sqrt(max(float(points[6, 6] - points[6, :6] @ follow), 0.0))
        moved = follow[:3]
    else:
        off = off_deg[:known] / world.attitude_deg
        follow = spread @ by_turn.T
        much = math.sqrt(max(float(off @ (off - by_turn @ follow @ off)), 0.0))
        moved = (follow @ off)[:3]
    away = float(moved @ np.linalg.solve(spread[:3, :3], moved))
    beyond = 1 - float(special.chndtr(SILENT_NEES, 3, away))
    found = []
    for alarm in alarms:
        not_found = float(special.ndtr(-special.ndtri(alarm) - much))
        found += [not_found, not_found * beyond]
    return found


def floors(fixes: int) -> None:
    """Print what no test of what is off can be below, at the default false alarm and at 1 %."""
    print("| what | not found | silent | not found, 1 % false alarms | silent |")
    print("|---|---|---|---|---|")
    for what, by in {REFOCUSED: None, **ATTITUDES}.items():
        for name, world in WORLDS.items():
            if by is not None and world.attitude == "none":
                continue
            rng = np.random.default_rng(0)
            known = 3 if world.attitude == "heading" else 2
            found = []
            for _ in range(fixes):
                seen = scene(world, rng)
                off = None if by is None else by(known, rng)
                found.append(floor(seen, off, world, (SPEC.false_alarm, 0.01)))
            texts = (f"{value:.2g}" for value in np.mean(found, 0))
            print(f"| {name}; {what} | " + " | ".join(texts) + " |", flush=True)


def row(world: World, fault: Fault | None, fixes: int, seed: int, spec: ErrorModel) -> dict[str, float]:
    """The figures of a row of the table."""
    rng = np.random.default_rng(seed)
    squares, hpl, vpl = [], [], []
    tried = allowed = left_out = protected = beyond = covered = 0
    while tried < fixes:
        tried += 1
        here = scene(world, rng)
        if fault is not None:
            fault(here, rng)
        found = solve_pose(here.views, here.camera, here.attitude, spec, here.sigma)
        if isinstance(found, Rejection):
            # What the geometry does not allow has nothing to do with faults.
            allowed += found.kind in ("misfit", "not-determined")
            continue
        allowed += 1
        left_out += bool(found.excluded)
        squares.append(square(found))
        hidden = squares[-1] > SILENT_NEES
        if math.isfinite(found.hpl_m) and math.isfinite(found.vpl_m):
            protected += 1
            hpl.append(found.hpl_m)
            vpl.append(found.vpl_m)
            flat, high = math.hypot(*found.enu_m[:2]), abs(found.enu_m[2])
            outside = flat > found.hpl_m or high > found.vpl_m
            beyond += outside
            covered += hidden and not outside
    given = max(len(squares), 1)
    silent = int((np.array(squares) > SILENT_NEES).sum())
    return {
        "NEES": float(np.mean(squares)) if squares else math.nan,
        "kept": len(squares) / max(allowed, 1),
        "silent": silent / max(allowed, 1),
        "beyond chance": (silent - CHANCE * len(squares)) / max(allowed, 1),
        "not covered": (silent - covered) / max(allowed, 1),
        "left out": left_out / given,
        "protected": protected / given,
        "HPL": float(np.median(hpl)) if hpl else math.nan,
        "VPL": float(np.median(vpl)) if vpl else math.nan,
        "beyond": beyond / max(protected, 1),
    }


def square(pose: Pose) -> float:
    """The error squared in its own sigmas."""
    return float(pose.enu_m @ np.linalg.solve(pose.covariance[:3, :3], pose.enu_m))


WORLDS = {
    "1 bar, heading": World(1, "heading"),
    "2 bars, gravity": World(2, "gravity"),
    "2 bars, heading": World(2, "heading"),
    "3 bars, none": World(3, "none"),
    "3 bars, gravity": World(3, "gravity"),
    "3 bars, heading": World(3, "heading"),
}


def stated_worlds() -> dict[str, World]:
    """Every world, and each with sigmas of survey and focal length."""
    survey = (0.05, math.radians(0.3), 0.002)
    found = {}
    for name, world in WORLDS.items():
        found[name] = world
        found[f"{name}; survey 5 cm, focal .5 %"] = replace(world, survey=survey, focal=0.005)
    return found


STEPS, STEP_S, SPEED_M_S = 20, 0.036, 11.0
"""Fixes of a drive, their distance in time, and the speed at first: 8 m."""


def drive(world: World, rng: np.random.Generator, spec: ErrorModel) -> tuple[list[Fix], Floats]:
    """Fixes past bars with errors of the sigmas and of the persistence that are stated, and the true places.

    Bars are 50 to 90 m ahead at first; the motion is what the track takes it for, white acceleration.
    """
    pitch, roll, heading = rng.uniform(0, 6), rng.normal(0, 1), rng.uniform(0, 360)
    rotation = Attitude(pitch, roll, heading).rotation()
    true = replace(CAMERA, focal_mm=CAMERA.focal_mm * (1 + world.focal * rng.normal()))
    off = rng.normal(0, world.attitude_deg, 3)
    attitude = measured_attitude(world, pitch + off[0], roll + off[1], (heading + off[2]) % 360)
    depth, (place, turn, length) = rng.uniform(50, 90), world.survey
    bars = []
    for slot in rng.permutation(3)[: world.bars]:
        ray = np.array([(slot - 1) * 0.055 + rng.uniform(-0.02, 0.02), rng.uniform(-0.025, 0.025), 1.0])
        axis = np.array([*rng.normal(0, 0.02, 2), 1.0])
        arm = ALONG[:, None] * axis / np.linalg.norm(axis)
        stands = rotation @ (ray * depth * rng.uniform(0.8, 1.0)) + arm
        stated = stands + rng.normal(0, place, 3) + np.cross(rng.normal(0, turn, 3), arm)
        stated = stated + rng.normal(0, math.hypot(length, spec.stretch_share)) * arm
        # What the place in a pixel makes of each point changes slowly.
        bars.append((stands, stated, rng.normal(0, PIXEL_PX, (16, 2))))
    fade = math.exp(-STEP_S / spec.slow_s)
    ahead = np.array([math.sin(math.radians(heading)), math.cos(math.radians(heading)), 0.0])
    state = np.concatenate([np.zeros(3), SPEED_M_S * ahead])
    power = spec.acceleration_m2_s3 * np.array([[STEP_S**3 / 3, STEP_S**2 / 2], [STEP_S**2 / 2, STEP_S]])
    root, sigma = np.linalg.cholesky(power), CameraSigma(focal_mm=world.focal * CAMERA.focal_mm)
    fixes, places = [], []
    for step in range(STEPS):
        views, vibration_px = [], rng.normal(0, spec.vibration_sigma_px, 2)
        for number, (stands, stated, slow) in enumerate(bars):
            slow[:] = fade * slow + math.sqrt(1 - fade**2) * rng.normal(0, PIXEL_PX, (16, 2))
            points, _ = project_bars(stands, state[:3], rotation, true)
            shift = own_shift(points, spec) @ rng.normal(size=2)
            off_px = (slow + rng.normal(0, NOISE_PX, points.shape)) @ across_scale(points)
            points, sigma_px = points + off_px + shift + vibration_px, np.full(16, POINT_PX)
            views.append(BarView(number, stated, points, sigma_px, world.survey, PIXEL_PX, across=ACROSS))
        found = solve_pose(views, CAMERA, attitude, spec, sigma)
        if isinstance(found, Pose):
            fixes.append(
                replace(
                    Fix.from_refusal(step * STEP_S * 1e6, found.transmitters, "", ""),
                    enu_m=found.enu_m,
                    covariance_m2=found.covariance[:3, :3],
                    noise_m2=found.noise,
                    slow_m2=found.slow,
                    standing=found.standing,
                    weakest_axis=found.weakest_axis,
                    standing_slope=found.standing_slope,
                    heading_deg=Attitude.of_rotation(found.rotation).heading_deg or 0.0,
                )
            )
            places.append(state[:3].copy())
        kick = root @ rng.normal(size=(2, 3))
        state[:3] += STEP_S * state[3:] + kick[0]
        state[3:] += kick[1]
    return fixes, np.array(places)


def tracks(drives: int) -> None:
    """Print NEES and errors of fixes, and of the track filtered and smoothed, for each world."""
    print("| what | fixes | NEES | 3D RMSE, m | track: NEES | m | smoothed: NEES | m |")
    print("|---" * 8 + "|")
    for what, of in stated_worlds().items():
        rng = np.random.default_rng(1)
        squares, errors = [], []
        for _ in range(drives):
            fixes, places = drive(of, rng, SPEC)
            points = filter_fixes(fixes, SPEC)
            smoothed = smooth_trajectory(points, SPEC)
            for fix, now, later, place in zip(fixes, points, smoothed, places, strict=True):
                off = fix.enu_m - place, now.mean[:3] - place, later.mean[:3] - place
                spread = fix.covariance_m2, now.covariance_m2, later.covariance_m2
                squares.append([e @ np.linalg.solve(p, e) for e, p in zip(off, spread, strict=True)])
                errors.append([e @ e for e in off])
        nees, rmse = np.mean(squares, 0), np.sqrt(np.mean(errors, 0))
        pairs = " | ".join(f"{n:.2f} | {m:.3f}" for n, m in zip(nees, rmse, strict=True))
        print(f"| {what} | {len(squares)} | {pairs} |", flush=True)


def speeds(fixes: int) -> None:
    """Print processor time of a fix without a fault, solved one after the other: the best of six rounds."""
    print("| what | ms |\n|---|---|")
    times_ms = []
    for what, of in stated_worlds().items():
        rng = np.random.default_rng(3)
        scenes = [scene(of, rng) for _ in range(fixes)]
        rounds_s = []
        for _ in range(6):
            began = time.process_time()
            for seen in scenes:
                solve_pose(seen.views, seen.camera, seen.attitude, SPEC, seen.sigma)
            rounds_s.append(time.process_time() - began)
        times_ms.append(min(rounds_s) / fixes * 1e3)
        print(f"| {what} | {times_ms[-1]:.3f} |", flush=True)
    print(f"| mean | {np.mean(times_ms):.3f} |")


REFOCUSED = "focal length .5 % off"
ATTITUDES: dict[str, Off] = {"attitude 1 degree off": turn_one_angle, "attitude 10 ms late": delay_attitude}
FAULTS: dict[str, Fault] = {
    "bar .5 m off": move_bar,
    "sites swapped": swap_sites,
    REFOCUSED: change_focal_length,
    **{what: turn_attitude(by) for what, by in ATTITUDES.items()},
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--fixes", type=int, default=2900, help="of a row")
    parser.add_argument("--only", default="", help="rows whose name contains this")
    parser.add_argument("--bar-fault", type=float, default=SPEC.bar_fault_m, help="m; position.bar_fault_m")
    parser.add_argument(
        "--max-protection", type=float, default=SPEC.max_protection_m, help="m; position.max_protection_m"
    )
    parser.add_argument("--floor", action="store_true", help="what no test can find, in closed form")
    parser.add_argument("--track", action="store_true", help=f"drives of {STEPS} fixes, --fixes in all")
    parser.add_argument("--speed", action="store_true", help="time of a fix")
    given = parser.parse_args()
    if given.speed:
        speeds(given.fixes)
        return
    if given.track:
        tracks(max(given.fixes // STEPS, 1))
        return
    if given.floor:
        floors(given.fixes)
        return
    spec = replace(SPEC, bar_fault_m=given.bar_fault, max_protection_m=given.max_protection)
    rows: list[tuple[str, World, Fault | None]] = []
    rows += [(name, world, None) for name, world in stated_worlds().items()]
    for what, fault in FAULTS.items():
        for name, world in WORLDS.items():
            if (fault is swap_sites and world.bars < 2) or (what in ATTITUDES and world.attitude == "none"):
                continue
            rows.append((f"{name}; {what}", world, fault))
    head = (
        "NEES", "kept", "silent", "beyond chance", "not covered", "left out", "protected", "HPL", "VPL",
        "beyond",
    )  # fmt: skip
    print("| what | " + " | ".join(head) + " |")
    print("|---" * (len(head) + 1) + "|")
    row(World(2, "gravity"), None, 5, 0, spec)
    for i, (name, world, wrong) in enumerate(rows):
        if given.only in name:
            found = row(world, wrong, given.fixes, i, spec)
            texts = (
                "-"
                if math.isnan(found[key])
                else f"{found[key]:.4f}"
                if key in ("silent", "beyond chance", "not covered", "beyond")
                else f"{found[key]:.3g}"
                for key in head
            )
            print(f"| {name} | " + " | ".join(texts) + " |", flush=True)


if __name__ == "__main__":
    main()
