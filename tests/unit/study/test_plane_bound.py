"""Bounds of any layout, against closed forms, a fit of drawn images, and the bound of boundaries."""

import math

import numpy as np
import pytest
from scipy.optimize import least_squares

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.scene.bar import BarLayout, LedTable
from evlcp_sdk.study.bound import _Image, bar_bound, frame_bound, layout_bound
from evlcp_sdk.values import FrameView, PresenceMap, SoftSymbols

RING_BAR = ["bar.shape=ring", "bar.leds=12", "bar.radius_m=0.25"]
RING, SMALL = load_link(overrides=RING_BAR), load_link(overrides=[*RING_BAR, "bar.led_m=0.001"])
FOCAL_PX = RING.camera.focal_px

# Light far below the background's, so that values follow it in proportion, and LEDs far smaller than the
# blur, which covers pixels: sums over pixels are then integrals of Gaussians.
FAINT, BLUR_PX, NOISE = 1e3, 1.5, 1e-4
VALUES = RING.codebook.pilot_edges.shape[1] + RING.codebook.codeword_edges.shape[1]


def one_led_information(side_px: float, gain: float = 0.8) -> float:
    """Of the place of one small, blurred, faint LED along an axis: values pi / 2 (peak / noise)^2."""
    peak = gain / FAINT * side_px**2 / (2 * math.pi * BLUR_PX**2)
    return VALUES * math.pi / 2 * (peak / NOISE) ** 2


@pytest.mark.parametrize("distance_m", [30.0, 50.0])
def test_a_ring_of_faint_leds_has_the_closed_form(distance_m: float) -> None:
    px_per_m = FOCAL_PX / distance_m
    each = one_led_information(0.001 * px_per_m)
    found = layout_bound(SMALL, distance_m, range(12), blur_px=BLUR_PX, noise=NOISE, dark=FAINT)
    radius_px, radius_m = 0.25 * px_per_m, 0.25
    together = math.sqrt(12 * each)
    assert found.x_px == pytest.approx(1 / together, rel=0.02)
    assert found.y_px == pytest.approx(1 / together, rel=0.02)
    assert found.distance_m == pytest.approx(distance_m / (radius_px * together), rel=0.02)
    assert math.radians(found.turn_deg) == pytest.approx(1 / (radius_px * together), rel=0.02)
    # A lean moves an LED outward by radius_px * radius_m / distance_m times the sine of its angle: squared,
    # summed 12 / 2; a shift of the ring explains half of that.
    lean = 2 * distance_m / (radius_px * radius_m * together)
    assert math.radians(found.lean_deg) == pytest.approx(lean, rel=0.02)
    assert math.radians(found.swing_deg) == pytest.approx(lean, rel=0.02)


def test_a_bar_has_nearly_the_bound_of_its_boundaries() -> None:
    # This one knows the outer edges, too, and that boundaries are LEDs beside each other.
    link = load_link()
    found = layout_bound(link, 50.0, range(16), blur_px=0.45, noise=0.3)
    wanted = bar_bound(link, 50.0, range(16), blur_px=0.45, noise=0.3, columns=2)
    assert found.distance_m == pytest.approx(wanted.distance_m, rel=0.1)
    assert found.lean_deg == pytest.approx(wanted.lean_deg, rel=0.2)
    assert math.isinf(found.swing_deg)


def test_a_fit_of_drawn_images_scatters_as_the_bound_says() -> None:
    layout = BarLayout(LedTable(((-0.1, -0.05, 0, 0), (0.12, -0.04, 0, 1), (0.02, 0.11, 0, 2), (0, 0, 0, 1))))
    rng = np.random.default_rng(4)
    codes = rng.choice([-1.0, 1.0], (3, 4))
    names = ("x_px", "y_px", "scale", "turn", "gain", "dark", "blur")
    true = np.array([0.2, -0.3, math.log(70.0), 0.1, 0.8, math.log(0.1), math.log(0.5)])
    across = np.arange(-12.0, 13.0)
    image = _Image.of(layout, codes, across, across, 50.0)

    def values(fit: np.ndarray) -> np.ndarray:
        return image.values(dict(zip(names, fit.tolist(), strict=True))).ravel()

    clean, fits = values(true), []
    for _ in range(12):
        drawn = clean + rng.normal(0, 0.05, clean.size)
        fits.append(least_squares(lambda fit, drawn=drawn: values(fit) - drawn, true, method="lm").x)
    given = dict(zip(names, true.tolist(), strict=True))
    slopes = np.stack([image.slope(given, name) for name in names])
    bound = np.sqrt(np.diag(np.linalg.inv(slopes @ slopes.T / 0.05**2)))
    # 48 squares of normal numbers tell their mean to 20 %.
    assert np.mean(((np.array(fits) - true) / bound)[:, :4] ** 2) == pytest.approx(1, abs=0.6)


def test_what_nothing_says_is_infinite() -> None:
    one = layout_bound(load_link(overrides=["bar.shape=table"]), 50.0, [3], blur_px=0.45, noise=0.3)
    assert one.x_px == pytest.approx(one.y_px)
    assert one.x_px < 0.2
    assert one.distance_m > 1000
    assert math.isinf(one.turn_deg)
    assert math.isinf(one.lean_deg)


@pytest.mark.parametrize("name", ["distance_m", "blur_px", "noise"])
def test_quantities_are_positive(name: str) -> None:
    given = {"distance_m": 50.0, "blur_px": 0.4, "noise": 0.1, name: 0.0}
    distance_m = given.pop("distance_m")
    with pytest.raises(ConfigError, match=f"{name} = 0"):
        layout_bound(RING, distance_m, range(12), **given)


def view_of(layout: BarLayout, distance_m: float, noise: float, seed: int) -> FrameView:
    """A frame of a layout whose values are the model's, with noise, as sums of three events."""
    rng = np.random.default_rng(seed)
    symbols = rng.integers(0, len(RING.codebook.codewords), layout.clusters)
    codes = np.concatenate([RING.codebook.pilot_edges, RING.codebook.codeword_edges[symbols]], 1).astype(
        np.float64
    )
    columns, rows = np.arange(50.0) - 24.5, np.arange(52.0) - 25.5
    fit = {"x_px": 0.3, "y_px": -0.2, "scale": math.log(FOCAL_PX / distance_m), "turn": 0.05}
    lens = {"gain": 0.7, "dark": math.log(0.1), "blur": math.log(0.5)}
    image = _Image.of(layout, codes, columns, rows, distance_m)
    clean = image.values(fit | lens).reshape(-1, 52, 50)
    # Full values are not clipped at one event in a hundred.
    events = 300.0 * np.clip(clean + rng.normal(0, noise, clean.shape), -1, 1)
    sums = np.zeros((2 * len(clean), 52, 50), np.int16)
    sums[1::2] = np.round(events)
    one = _Image.of(layout, np.eye(layout.clusters), columns, rows, distance_m)
    light = one.values(fit | lens).reshape(-1, 52, 50)
    cells = light.reshape(-1, 26, 2, 25, 2).mean((2, 4)) > 0.05
    presence = PresenceMap(cells.astype(np.float32), 2, cells, light.astype(np.float32))
    soft = SoftSymbols(symbols, np.zeros((layout.clusters, 6), np.float32), 1.0)
    return FrameView(sums, np.zeros((2, len(sums))), presence, soft)


def test_the_bound_of_a_frame_is_that_of_its_image() -> None:
    measure = frame_bound(RING, full_events=300.0)
    found = measure(view_of(RING.bar, 90.0, 0.1, seed=1))
    want = layout_bound(
        RING, 90.0, range(12),
        blur_px=0.5, noise=0.1, gain=0.7, dark=0.1, shift_px=(0.3, -0.2), turn_deg=math.degrees(0.05),
    )  # fmt: skip
    assert found.pairs == 12
    assert found.sigma_m == pytest.approx(want.distance_m, rel=0.25)
    assert abs(found.distance_m - 90.0) < 4 * want.distance_m


def test_a_frame_without_light_has_no_bound() -> None:
    view = view_of(RING.bar, 90.0, 0.1, seed=1)
    measure = frame_bound(RING)
    dark = FrameView(np.zeros_like(view.sums), view.offset_px, view.presence, view.soft)
    assert math.isnan(measure(dark).sigma_m)
