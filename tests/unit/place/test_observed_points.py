"""A bar's image points between frames, with sigmas that hold; its point in the camera's axes."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.observations import BarView
from evlcp_sdk.place.points import interpolate_points, locate_bar, sampling_error_px
from evlcp_sdk.scene.camera import CAMERA_PARAMETERS, CameraModel, CameraSigma
from evlcp_sdk.values import Frame, Range, SoftSymbols
from tests.unit.place.place_scenes import POINTS_ONLY, Floats, by_chance, frame, square

SPEC = ErrorModel(pixel_sigma_px=0.08)
EXACT = replace(SPEC, pixel_sigma_px=0.0, timing_sigma_us=0.0)
T_US = (np.arange(9) - 4.3) * 3600.0
BAR_PX = np.stack([np.full(16, 300.0), 200.0 + 8.0 * np.arange(16)], 1)
LINE_M = np.stack([np.zeros(16), 0.06 * np.arange(16), np.zeros(16)], 1)
LEVER = (np.arange(16) - 7.5) / 7.5
LINE = math.sqrt(np.linalg.inv(np.vander(T_US / 1e4, 2).T @ np.vander(T_US / 1e4, 2))[1, 1])
"""Sigma at 0 of a straight line through the frames, of errors of 1."""


def view_of_frames(points_px, sigma_px, spec=SPEC, layout_m=LINE_M, flank_px=math.nan, t_us=T_US) -> BarView:
    """A bar at 0 by its frames, float64 (9, 16, 2)."""
    frames = [
        replace(frame(points, sigma_px, t), points_flank_px=flank_px)
        for t, points in zip(t_us.tolist(), points_px, strict=True)
    ]
    found = interpolate_points(7, frames, 0.0, 40_000.0, layout_m, spec)
    assert found is not None
    return found


def trials(
    seed: int, step_px: float, white_px: float | list[float], *,
    pixel_px: float = 0.0, lean: float = 0.0, stated_px: float = 0.1, spec: ErrorModel = SPEC,
) -> tuple[Floats, Floats, Floats, Floats]:  # fmt: skip
    """Errors of the shape, float64 (400, 16, 2), and what is said of them: sigmas, of pixels, and across.

    Between two frames the image moves by a step to the right. An error within pixels is a Gaussian process of
    the place, which forgets within a pixel; beside it white errors, and in each frame another lean.
    """
    rng = np.random.default_rng(seed)
    course = T_US[:, None, None] / 3600.0 * np.array([step_px, 0.0])
    apart = np.abs(T_US[:, None] - T_US) / 3600.0 * step_px
    root = np.linalg.cholesky(np.exp(-apart) + 1e-9 * np.eye(9))
    errors, views = [], []
    for _ in range(400):
        pixel = np.einsum("ij,jkl->ikl", root, rng.normal(0, pixel_px, (9, 16, 2)))
        points = BAR_PX + course + pixel + rng.normal(0, white_px, (9, 16, 2))
        points[:, :, 0] += 60.0 * LEVER * rng.normal(0, lean, 9)[:, None]
        views.append(view_of_frames(points, stated_px, spec))
        errors.append(views[-1].points_px - BAR_PX)
    off = np.array(errors)
    reported = ([getattr(view, name) for view in views] for name in ("sigma_px", "pixel_px", "across"))
    return off - off.mean(1, keepdims=True), *map(np.array, reported)


@pytest.mark.parametrize("step_px", [0.0, 0.5, 3.0])
def test_an_error_within_pixels_stays_as_long_as_the_image_does(step_px: float) -> None:
    errors, sigmas, pixels, _ = trials(1, step_px, 0.1, pixel_px=0.08)
    # Their mean is taken with the bar's place.
    pixel = math.sqrt(errors.var() * 16 / 15 - (0.1 * LINE) ** 2)
    assert pixels.mean() == pytest.approx(pixel, rel=0.12)
    # Where it moves, frames scatter by it, too, which is not told from a lean.
    assert 0.7 < math.sqrt((errors**2).mean() * 16 / 15) / sigmas.mean() < 1.1
    if step_px == 0:
        assert pixels == pytest.approx(0.08, abs=0.003)


def test_a_bar_of_another_tilt_in_each_frame_is_less_sure() -> None:
    errors, sigmas, _, across = trials(3, 3.0, 0.05, lean=0.01, stated_px=0.05)
    mode = LEVER / np.linalg.norm(LEVER)
    lean = errors[:, :, 0] @ mode
    reported = across * np.sqrt((sigmas**2) @ mode**2)
    # Of a variance estimated with 7 degrees of freedom: Student's t, 7 / 5, and 3 sigmas .02.
    assert 0.9 < float(np.mean((lean / reported) ** 2)) < 1.7
    assert float(np.mean(np.abs(lean) > 3 * reported)) < 0.04
    # Along it, they scatter as they say.
    assert float(np.mean(sigmas**2)) < 0.2 * float(np.mean(reported**2))
    # By what frames state alone it was beyond 3 sigmas in the mean.
    assert float(np.mean((lean / math.hypot(0.05 * LINE, 0.03)) ** 2)) > 10


@pytest.mark.parametrize("across_px", [0.02, 0.06, 0.18])
def test_errors_across_a_bar_are_stated_by_what_it_shows(across_px: float) -> None:
    """White errors of another size across than along: said within a factor of what there is, safe side."""
    errors, sigmas, _, across = trials(4, 0.0, [across_px, 0.06], stated_px=0.06, spec=EXACT)
    there, along = np.var(errors, axis=(0, 1)) * 16 / 15, sigmas.mean(1)
    # The lean's share is taken larger than the points' about a line, by 1.8, and of two estimates the larger.
    assert 1.2 < np.mean((across * along) ** 2) / there[0] < 2.3
    assert 1.0 < np.mean(along**2) / there[1] < 1.5


def view_of_layout(layout_m: Floats, noise_px: float, seed: int) -> BarView:
    """A layout some 50 m ahead, turned and leaning, with errors that all frames share."""
    rng = np.random.default_rng(seed)
    turned = layout_m @ Rotation.from_euler("xyz", [25.0, 20.0, 10.0], degrees=True).as_matrix().T
    image = 640.0 + 7000.0 * turned[:, :2] / (50.0 + turned[:, 2:])
    points = image + rng.normal(0, noise_px, image.shape)
    return view_of_frames(np.repeat(points[None], 9, 0), 0.06, EXACT, layout_m)


@pytest.mark.parametrize("shape", ["line", "columns", "ring"])
def test_a_layouts_own_form_and_its_perspective_are_no_errors(shape: str) -> None:
    """Columns 2 cm beside one another are a line to a fit, and 3 px beside it; a ring is none."""
    turn, k = 2 * np.pi * np.arange(16) / 16, np.arange(16)
    places = {
        "line": (np.zeros(16), 0.06 * k),
        "columns": (0.02 * (k % 2), 0.06 * k),
        "ring": (0.4 * np.cos(turn), 0.4 * np.sin(turn)),
    }[shape]
    layout_m = np.stack([*places, np.zeros(16)], 1)
    exact = view_of_layout(layout_m, 0.0, 0)
    assert exact.across * exact.sigma_px.mean() < 0.003
    # What stands over all frames does not scatter, and is shown.
    bars = [view_of_layout(layout_m, 0.05, seed) for seed in range(200)]
    squares = [(found.across * found.sigma_px.mean()) ** 2 for found in bars]
    assert 1.2 < np.mean(squares) / 0.05**2 < 2.2


def test_too_few_clusters_show_nothing_of_their_errors_and_points_without_are_not_exact() -> None:
    still = np.repeat(BAR_PX[None], 9, 0)
    assert view_of_frames(still[:, :4], 0.1, replace(EXACT, min_points=2), LINE_M[:4]).across == 1.0
    assert view_of_frames(still, 0.1, EXACT).across == pytest.approx(0.1)


def test_what_a_thin_line_does_not_show_is_that_of_a_sampled_profile() -> None:
    """Brute force: means of trapezoids seen once a pixel, at all places and of many widths."""
    columns, places = np.arange(-12, 13), np.linspace(0, 1, 50, endpoint=False)
    for steep_px in (0.2, 0.5, 0.8):
        errors = []
        for width_px in np.linspace(3, 4, 40, endpoint=False):
            away = np.abs(columns - places[:, None])
            light = np.clip((width_px / 2 - away) / steep_px + 0.5, 0, 1)
            errors.append((light @ columns) / light.sum(1) - places)
        # Of a step, the second wave has a quarter of the first one's power.
        assert 0.95 <= np.var(errors) / sampling_error_px(steep_px / 0.9) ** 2 <= 1.5
    assert sampling_error_px(2.0) == sampling_error_px(math.nan) == 0.0


@pytest.mark.parametrize(("step_px", "least", "most"), [(0.0, 1.0, 1.0), (0.2, 0.9, 1.0), (5.0, 0.7, 0.85)])
def test_what_is_not_shown_averages_as_the_image_moves(step_px: float, least: float, most: float) -> None:
    points = BAR_PX + T_US[:, None, None] / 3600.0 * np.array([step_px, 0.0])
    share = view_of_frames(points, 0.1, flank_px=0.6).shift_px / sampling_error_px(0.6)
    assert least - 1e-9 <= share <= most + 1e-9
    assert view_of_frames(points, 0.1).shift_px == 0.0


def test_a_moving_image_is_seen_early_or_late_by_its_speed() -> None:
    for px_per_ms in (0.0, 2.0, 6.0):
        points = BAR_PX + T_US[:, None, None] / 1000.0 * np.array([0.6, -0.8]) * px_per_ms
        found = view_of_frames(points, 0.1, replace(SPEC, timing_sigma_us=15.0))
        assert found.timing_px == pytest.approx(0.015 * px_per_ms, abs=1e-12)


def test_a_gap_beside_a_fix_is_known_by_how_far_a_polynomial_may_be_off() -> None:
    """A quartic of the image's motion, of which frames show a cubic: off by a share of its coefficient."""
    for t_us in (T_US, np.where(T_US > 0, T_US + 2600.0, T_US)):
        quartic = 1e-16 * t_us**4
        points = BAR_PX + quartic[:, None, None] * np.array([1.0, 0.0])
        found = view_of_frames(points, 0.1, t_us=t_us)
        midway = 1e-16 * 0.5625 * 3600.0**4
        off = abs(found.points_px[:, 0].mean() - 300.0)
        assert found.vibration == pytest.approx(off / midway, rel=1e-6)


BENT = CameraModel(focal_mm=8.0, k1=-0.2, k2=0.05, p1=1e-3, p2=-1e-3, centre_x_px=650.0, centre_y_px=350.0)
LENS = CameraSigma(0.04, 2.0, 2.0, 0.01, 0.01, 1e-4, 1e-4)
STRETCHED = replace(POINTS_ONLY, vibration_sigma_px=0.1, shared_sigma_px=0.17320508, shared_share=0.002)
STRETCHED = replace(STRETCHED, shared_along_px=ErrorModel.shared_along_px, stretch_share=0.004)
SOFT = SoftSymbols(np.zeros(16, np.int64), np.zeros((16, 6), np.float32), 1.0)


def ranged_frame(x_px: float, y_px: float, distance_m: float, sigma_m: float) -> Frame:
    return Frame(0, 0, 0, 0.0, SOFT, Range(distance_m, sigma_m, 10), None, x_px, y_px)


def test_the_point_is_the_one_that_is_seen() -> None:
    true = np.array([3.0, -2.0, 40.0])
    x, y = BENT.project(true)
    found = locate_bar(ranged_frame(x, y, 40.0, 0.1), 0.96, BENT)
    np.testing.assert_allclose(found.point_m, true, atol=1e-6)
    # The sigma of the distance is along the line of sight, not along the axis.
    along = true / 40.0
    spec = replace(POINTS_ONLY, stretch_share=0.001)
    exact = locate_bar(ranged_frame(x, y, 40.0, 0.1), 0.96, BENT, spec=spec)
    stretched = 0.1**2 + (40 * 0.001) ** 2
    np.testing.assert_allclose(exact.covariance_m2, stretched * np.outer(along, along), atol=1e-9)
    # Without a distance, or its sigma, there is none.
    for distance_m in (math.nan, 40.0):
        assert locate_bar(ranged_frame(x, y, distance_m, math.nan), 0.96, BENT) is None


def test_what_bends_a_bar_stays_over_frames() -> None:
    bent = replace(ranged_frame(640.0, 360.0, 40.0, 0.5), range=Range(40.0, 0.5, 10, standing_m=0.4))
    found = locate_bar(bent, 0.96, BENT, spec=replace(POINTS_ONLY, stretch_share=0.0))
    straight = locate_bar(ranged_frame(640.0, 360.0, 40.0, 0.5), 0.96, BENT, spec=POINTS_ONLY)
    np.testing.assert_allclose(found.covariance_m2, straight.covariance_m2, rtol=1e-3, atol=1e-6)
    assert found.standing[2, 7] == pytest.approx(0.4)
    frames = [replace(frame(BAR_PX, 0.1, t), range=bent.range) for t in T_US.tolist()]
    for some, stretch in ((9, 0.01), (5, 0.01), (4, 0.0)):
        near = frames[:some] + [replace(one, range=Range(40.0, 0.1, 10)) for one in frames[some:]]
        view = interpolate_points(7, near, 0.0, 40_000.0, LINE_M, SPEC)
        assert view.stretch == pytest.approx(stretch)


def test_every_error_is_in_its_covariance() -> None:
    rng = np.random.default_rng(3)
    true, squares = np.array([3.0, -2.0, 25.0]), []
    for _ in range(400):
        root = LENS.covariance_root(BENT)
        off = root @ rng.normal(size=7)
        names = CAMERA_PARAMETERS[1:]
        values = {name: getattr(BENT, name) + v for name, v in zip(names, off[1:], strict=True)}
        lens = replace(BENT, focal_mm=BENT.focal_mm * (1 + off[0] / BENT.focal_px), **values)
        shift = math.hypot(0.2, 0.002 * BENT.focal_px * 0.96 / 25)
        x, y = lens.project(true) + rng.normal(0, shift, 2)
        # By its length in the image a bar is the farther, the longer the lens is said to be.
        distance = 25 * BENT.focal_px / lens.focal_px * (1 + 0.004 * rng.normal()) + 0.15 * rng.normal()
        found = locate_bar(ranged_frame(x, y, distance, 0.15), 0.96, BENT, LENS, STRETCHED)
        squares.append(square(found.point_m - true, found.covariance_m2))
    assert by_chance(squares, 3, 0.999)
    assert np.linalg.eigvalsh(found.covariance_m2 - found.standing @ found.standing.T)[0] > 0
