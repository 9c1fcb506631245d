"""Where a layout lies in an image: drawn bars with neighbours, mirror images, covers and clutter."""

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from evlcp_sdk.rx.placement import find_placements, layout_of, mask_presence
from evlcp_sdk.scene.bar import BarLayout, LedColumns, LedGrid
from evlcp_sdk.values import PresenceMap

CENTRES = BarLayout().cluster_centres_m()
LINE = layout_of(CENTRES)
PANEL = BarLayout(LedGrid(rows=16, columns=16, led_pitch_m=0.02, cluster_rows=4, cluster_columns=4))
SIZE = (48, 224)
SEEDS = range(6)


def map_of(selected):
    """Cells of 2 px that show what they are selected for."""
    shown = selected.astype(np.float32)
    return PresenceMap(shown, 2, selected, shown.repeat(2, 1).repeat(2, 2))


def draw_cells(centres_m, *instances, size=SIZE, half_px=2.0, conj=False):
    """Cells of 2 px whose middle lies in a cluster of an instance (scale, shift)."""
    width, height = size
    y, x = np.mgrid[: height // 2, : width // 2] * 2 + 0.5
    at = centres_m @ [1, 1j]
    gap = np.abs(at[0] - at[1:]).min() if len(at) > 1 else 0.0
    selected = np.zeros((len(at), height // 2, width // 2), bool)
    for scale, shift in instances:
        off = (x + 1j * y - shift) / scale
        off = (np.conj(off) if conj else off) - at[:, None, None]
        across = half_px / abs(scale) if np.ptp(at.real) == 0 else gap / 2
        selected |= (np.abs(off.imag) <= gap / 2) & (np.abs(off.real) <= across)
    return map_of(selected)


def add_clutter(presence, rng, share):
    """A share of all cells shows clusters at random."""
    selected = presence.selected
    hit = rng.random(selected.shape[1:]) < share
    which = rng.integers(0, len(selected), hit.shape) == np.arange(len(selected))[:, None, None]
    return map_of(np.where(hit, which, selected))


def cover_clusters(presence, clusters):
    return map_of(presence.selected & ~np.isin(np.arange(len(presence.selected)), clusters)[:, None, None])


@settings(max_examples=40)
@given(st.floats(40, 200), st.floats(-math.pi, math.pi), st.floats(0, 2), st.floats(0, 2))
def test_a_bar_at_any_size_and_turn(px_per_m, turn, right, down):
    scale, shift = px_per_m * np.exp(1j * turn), complex(112 + right, 112 + down)
    (found,) = find_placements(draw_cells(CENTRES, (scale, shift), size=(224, 224)), LINE)
    # A cell is two pixels wide.
    assert np.abs(found.centres_px - scale * LINE.centres_m - shift).max() < 1.5
    assert found.seen.all()
    assert found.chance < 1e-6


@pytest.mark.parametrize("seed", SEEDS)
def test_clutter_and_a_cover(seed):
    rng = np.random.default_rng(seed)
    hidden = sorted(rng.choice(16, 8, replace=False).tolist())
    scale, shift = 150 * np.exp(0.02j), 24.3 + 110.2j
    presence = add_clutter(cover_clusters(draw_cells(CENTRES, (scale, shift)), hidden), rng, 0.05)
    found = find_placements(presence, LINE)[0]
    # The centre is the layout's, not that of the part that is seen.
    assert abs(found.shift - shift) < 1.5
    assert abs(found.scale - scale) < 4
    assert not set(np.flatnonzero(~found.seen)) - set(hidden)


def test_a_reflection_beside_stays_out_of_the_footprints():
    bar, image = (100 + 0j, 12.0 + 60j), (100 + 0j, 34.0 + 60j)
    presence = draw_cells(CENTRES, bar, image, size=(48, 120))
    found = find_placements(presence, LINE)
    assert len(found) == 2
    assert sorted(round(f.shift.real) for f in found) == [12, 34]
    for f in found:
        only = mask_presence(presence, LINE, f)
        assert only.selected.any((1, 2)).all()
        columns = np.flatnonzero(only.selected.any((0, 1))) * 2 + 0.5
        assert np.abs(columns - f.shift.real).max() < 4
        assert not (only.selected & ~presence.selected).any()


@pytest.mark.parametrize("seed", range(5))
def test_bayes_cell_by_cell(seed):
    rng = np.random.default_rng(seed)
    probability, prior = (rng.dirichlet(np.full(6, 0.3), (7, 4)).T[:-1] for _ in range(2))
    probability[:, :, 3] = prior[:, :2] = 0
    shown, before = (np.ascontiguousarray(one, np.float32) for one in (probability, prior))
    presence = PresenceMap(shown, 2, probability > 0.5, np.zeros((5, 8, 14), np.float32), before)
    none = 1 - probability.sum(0)
    # By as many chances as there are clusters, none has the likelihood that is left.
    likely = np.where(probability.any(0), probability * 5 / np.maximum(none, 1e-6), 1)
    both = likely * prior
    want = both / (both.sum(0) + np.maximum(1 - prior.sum(0), 1e-6))
    np.testing.assert_allclose(presence.apply_prior().probability, want, rtol=2e-3, atol=1e-5)


def test_few_clusters_are_enough_where_the_scale_is_known():
    whole = draw_cells(CENTRES, (150, 24 + 110j))
    (before,) = find_placements(whole, LINE)
    for hidden in (range(11), range(5, 16), [k for k in range(16) if k not in (2, 6, 7, 8, 13)]):
        (found,) = find_placements(cover_clusters(whole, hidden), LINE, before)
        assert abs(found.shift - (24 + 110j)) < 2
        assert found.seen.sum() == 5
    # Three could be there by chance.
    assert not find_placements(cover_clusters(whole, range(13)), LINE, before)


@pytest.mark.parametrize("seed", SEEDS)
def test_clusters_out_of_their_order_are_no_bar(seed):
    presence = draw_cells(CENTRES[np.random.default_rng(seed).permutation(16)], (150, 24 + 110j))
    (before,) = find_placements(draw_cells(CENTRES, (150, 24 + 110j)), LINE)
    assert find_placements(presence, LINE) == find_placements(presence, LINE, before) == []


@pytest.mark.parametrize("conj", [False, True])
def test_a_panel_and_its_mirror_image(conj):
    centres = PANEL.cluster_centres_m()
    layout = layout_of(centres)
    scale, shift = 300 * np.exp(0.1j), 64.2 + 63.7j
    (found,) = find_placements(draw_cells(centres, (scale, shift), size=(128, 128), conj=conj), layout)
    assert found.mirrored == conj
    assert abs(found.shift - shift) < 1
    assert np.abs(found.scale - scale) < 6
    places = found.centres_px
    assert np.abs(places[1] - places[0]) == pytest.approx(300 * 0.08, rel=0.03)


@pytest.mark.parametrize("column", [0, 1])
def test_one_column_of_two_is_not_taken_for_the_other_in_a_mirror(column):
    """It looks the same in both; in an image the layout then stands on the other side."""
    centres = BarLayout(LedColumns(columns=2, apart_m=2.0, rows=48)).cluster_centres_m()
    rng, found = np.random.default_rng(column), []
    for _ in range(24):
        scale = 120 * np.exp(0.01j * rng.normal())
        shift = complex(24, 60) + complex(*rng.uniform(-1, 1, 2)) - scale * (2 * column - 1)
        shown = draw_cells(centres, (scale, shift), size=(48, 120))
        found += find_placements(cover_clusters(shown, np.arange(8) + 8 - 8 * column), layout_of(centres))[:1]
    assert [one.mirrored for one in found] == [False] * 24


def test_one_cluster_is_where_its_cells_are():
    layout, presence = layout_of(np.zeros((1, 2))), draw_cells(np.zeros((1, 2)), size=(40, 40))
    presence.selected[0, 3:5, 7:9] = True
    (found,) = find_placements(presence, layout)
    assert found.shift == 15.5 + 7.5j
    assert mask_presence(presence, layout, found) is presence


def test_nothing_seen_is_nowhere():
    assert find_placements(draw_cells(CENTRES), LINE) == []
