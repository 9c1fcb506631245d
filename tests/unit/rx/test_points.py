"""Cluster points: on drawn bars, and on a simulated drive with its truth, and on a recording."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose
from rx_streams import LINK, frames_of, receive_cut

from evlcp_sdk.files import find_shipped_file
from evlcp_sdk.io import read_events
from evlcp_sdk.rx.placement import find_placements, layout_of
from evlcp_sdk.rx.points import compile_finder
from evlcp_sdk.scene.bar import BarLayout, LedGrid
from evlcp_sdk.sim import Simulation, load_scene
from evlcp_sdk.sim.motion import project
from evlcp_sdk.values import Events, PresenceMap, replace_fields

BAR = BarLayout()
CENTRES = BAR.cluster_centres_m()
FINE = 8
"""Parts that a pixel's side is cut into to draw with."""


def draw_clusters(layout, turn, shift, half_m, size):
    """Clusters as boxes of `half_m`, each pixel with its share of each: an ideal image."""
    width, height = size
    y, x = (np.mgrid[: height * FINE, : width * FINE] + 0.5) / FINE - 0.5
    place = (x + 1j * y - shift) / turn
    pixels = np.empty((len(layout), height, width), np.float32)
    for k, (a, b) in enumerate(layout):
        inside = (np.abs(place.real - a) <= half_m[0]) & (np.abs(place.imag - b) <= half_m[1])
        pixels[k] = inside.reshape(height, FINE, width, FINE).mean((1, 3))
    cells = pixels.reshape(len(layout), height // 2, 2, width // 2, 2).max((2, 4)) > 0.1
    return PresenceMap(cells.astype(np.float32), 2, cells, pixels)


def points_of(presence, centres_m=CENTRES, at_px=(0.0, 0.0), pixels=None, **placed):
    """Points, sigmas, their time and the centre, by pilots of which each has an edge of its own."""
    layout = layout_of(centres_m)
    light = np.rint(100 * presence.pixels).astype(np.int16)
    sums = np.concatenate([np.zeros_like(light[:1]), light])
    placement = replace(find_placements(presence, layout)[0], **placed)
    seen = presence if pixels is None else replace_fields(presence, pixels=pixels)
    return compile_finder(layout, np.eye(len(light), dtype=np.int64), 1)(seen, placement, sums, at_px)


def truth_of(turn, shift, layout):
    z = turn * (layout @ [1, 1j]) + shift
    return np.stack([z.real, z.imag], -1)


@settings(max_examples=25)
@given(st.floats(75, 220), st.floats(-0.15, 0.15), st.integers(0, FINE), st.integers(0, FINE))
def test_points_of_an_ideal_bar(px_per_m, roll, right, down):
    turn, shift = px_per_m * np.exp(1j * roll), 24 + 112j + complex(right, down) / FINE
    presence = draw_clusters(CENTRES, turn, shift, (1.2 / px_per_m, 0.03), (48, 224))
    points, sigma, *_ = points_of(presence)
    off = points - truth_of(turn, shift, CENTRES)
    assert np.abs(off).max() < 0.2
    # Drawn in eighths of a pixel.
    assert np.sqrt(np.mean(off**2)) < 0.08
    assert (sigma[1:-1] < 0.12).all()
    assert_allclose(sigma[[0, -1]], 1.5 * sigma[1])
    assert (sigma[[0, -1]] > sigma[1]).all()


@pytest.mark.parametrize("turn", [-150.0, 150j, -150j])
def test_a_lying_bar_and_one_upside_down(turn):
    size = (200, 48) if turn.imag else (48, 200)
    shift = complex(size[0] / 2 + 0.3, size[1] / 2 - 0.2)
    points, *_ = points_of(draw_clusters(CENTRES, turn, shift, (0.008, 0.03), size))
    assert np.abs(points - truth_of(turn, shift, CENTRES)).max() < 0.2


def test_dark_clusters_are_unseen_and_cells_out_of_place_are_left_out():
    presence = draw_clusters(CENTRES, 150, 24.3 + 100.4j, (0.008, 0.03), (48, 200))
    selected, pixels = presence.selected, presence.pixels
    selected[4], pixels[4] = False, 0
    selected[9, 5:8, 2], pixels[9, 10:16, 4:6] = True, 0.9
    points, sigma, *_ = points_of(presence)
    assert np.isnan([*points[4], sigma[4]]).all()
    off = np.delete(points - truth_of(150, 24.3 + 100.4j, CENTRES), 4, axis=0)
    assert np.abs(off).max() < 0.2
    assert sigma[3] > sigma[2]


@pytest.mark.parametrize("down", [1, -1], ids=["upright", "mirrored"])
def test_a_panel_has_neighbours_on_both_axes(down):
    panel = BarLayout(LedGrid(rows=16, columns=16, cluster_rows=4, cluster_columns=4))
    layout = panel.cluster_centres_m()
    turn, shift = 700 * np.exp(0.05j), 64.2 + 63.7j
    shown = layout * [1, down]
    presence = draw_clusters(shown, turn, shift, (0.02, 0.02), (128, 128))
    points, *_ = points_of(presence, layout)
    assert np.abs(points - truth_of(turn, shift, shown)).max() < 0.25


def test_two_clusters_give_no_points():
    presence = draw_clusters(CENTRES, 150, 24 + 100j, (0.008, 0.03), (48, 200))
    points, sigma, _, centre_px = points_of(presence, at_px=(3.0, 5.0), seen=np.arange(16) < 2)
    assert points.shape == (16, 2)
    assert np.isnan([*points.T, sigma]).all()
    assert centre_px == pytest.approx((24 + 3, 100 + 5), abs=1)


@settings(max_examples=25)
@given(st.floats(0, 2))
def test_cells_that_hold_more_of_one_side_do_not_shift_a_bar(dx):
    whole = draw_clusters(CENTRES, 150.0, complex(24 + dx, 100), (2.6 / 150, 0.03), (48, 200))
    first, want = 2 * int((24 + dx - 2) / 2), (24 + dx + 8, 100 + 2)
    pixels = whole.pixels.copy()
    pixels[:, :, :first] = pixels[:, :, first + 4 :] = 0
    points, _, _, centre_px = points_of(whole, at_px=(8.0, 2.0), pixels=pixels)
    # As drawn, an edge is right to half a part of a pixel.
    assert np.abs(points[:, 0] - want[0]).max() <= 0.5 / FINE
    assert np.abs(np.subtract(centre_px, want)).max() <= 0.5 / FINE


def lies(points):
    """Whether a bar is wider than it is high."""
    return np.ptp(points[:, 0]) > np.ptp(points[:, 1])


def simulated_errors(scene, sets, seed=None, lying=False):
    """By how much points of a scene's upright or lying bar are off its truth, px, (frames, K, 2)."""
    simulation = Simulation(load_scene(scene, sets), seed)
    frames = frames_of(receive_cut(LINK, Events.concat(list(simulation.stream())))[1])
    mine = [f for f in frames if np.isfinite(f.points_px).all() and lies(f.points_px) == lying]
    bars = [bar.strips[0].cuts_m() for bar in simulation.bars]
    cuts = next(cuts for cuts in bars if lies(cuts) == lying)
    at = simulation.path.sample(np.array([f.points_t_us for f in mine]) - simulation.scene.t0_us)
    want, _ = project((cuts[1:] + cuts[:-1]) / 2, *at, simulation.scene.camera)
    return np.array([f.points_px for f in mine]) - want


def test_points_of_a_turning_camera_lie_where_they_are():
    """At 45 degrees a second the image moves by half a pixel in a chip."""
    sets = ["duration_s=0.1", 'motion.path_file="turning.csv"', "motion.vib_rate_rad_s=0.02"]
    off = simulated_errors("examples/scenes/one-bar.toml", sets, 5)
    assert len(off) > 12
    # All are early alike, by a share of a chip.
    assert np.abs(off.mean((0, 1))).max() < 0.3
    shape = off - off.mean(1, keepdims=True)
    assert np.abs(shape.mean(0)).max() < 0.25
    assert shape.std() < 0.2


def test_sigma_is_the_scatter_about_the_similarity():
    squares, freedom = 0.0, 0
    for frame in frames_of(
        receive_cut(LINK, read_events(find_shipped_file("recordings", "night-50m-30kmh-cut.raw")))[1]
    ):
        seen = np.isfinite(frame.points_px[:, 0])
        z, c = (one[seen] @ [1, 1j] for one in (frame.points_px, CENTRES))
        w = 1 / frame.points_sigma_px[seen]
        a = np.stack([c, np.ones_like(c)], 1) * w[:, None]
        left = z * w - a @ np.linalg.lstsq(a, z * w)[0]
        squares += (np.abs(left) ** 2).sum()
        freedom += 2 * len(z) - 4
    # Along and across errors differ, and neighbours share a boundary: the mean counts, not the exact law.
    assert 0.5 < squares / freedom < 1.5
    assert freedom > 500
