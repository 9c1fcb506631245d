"""Which transmitter is the reflection of which: the evidence, the decision, and the receiver."""

import math
from itertools import pairwise, permutations

import numpy as np
import pytest
from rx_streams import LINK, frames_of, receive_cut

import evlcp_sdk as evlcp
from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.rx.reflections import FrameDetection, Reflections, repetition_llr
from evlcp_sdk.values import Events, Frame, Range, SoftSymbols

FORMAT = PacketFormat()
PERIOD_US = FORMAT.packet_chips * FORMAT.chip_us
CODEWORDS = 64


def frame(transmitter, number, symbols=None, *, late_us=0.0, x_px=None, light=100.0, **more):
    """The frame of a number since the start."""
    symbols = frame_content(number) if symbols is None else symbols
    packet, index = divmod(number, FORMAT.frames)
    t_us = packet * PERIOD_US + FORMAT.frame_start_chip(index) * FORMAT.chip_us + late_us
    soft = SoftSymbols(symbols, np.zeros((len(symbols), 6), np.float32), 1.0)
    place = 400.0 + 40 * transmitter if x_px is None else x_px, more.get("y_px", 300.0)
    frame = Frame(transmitter, packet, index, t_us, soft, Range(math.nan, math.nan, 0), None, *place)
    times = t_us, t_us + 3200, packet * PERIOD_US, FORMAT.chip_us
    return FrameDetection(frame, *times, light, int((symbols >= 0).sum()), more.get("mirrored", False))


def frame_content(number, seed=0):
    """What a frame says."""
    return np.random.default_rng((seed, number)).integers(0, CODEWORDS, 16)


def misread(symbols, right, rng):
    """Symbols of which so many are right, at random places."""
    wrong = rng.permutation(np.arange(len(symbols)) >= right)
    return (symbols + wrong * rng.integers(1, CODEWORDS, len(symbols))) % CODEWORDS


@pytest.mark.parametrize(("codewords", "clusters"), [(64, 16), (16, 16), (256, 16), (64, 2), (2, 16)])
def test_evidence_is_the_likelihood_ratio_of_the_two_models(codewords, clusters):
    """Of models in which a share of the symbols is repeated and the rest drawn, case by case."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        one, other = rng.integers(-1, min(codewords, 4), (2, clusters))
        both, same = (one >= 0) & (other >= 0), one == other
        likely, chance = (share * same + (1 - share) / codewords for share in (1 / 4, 1 / 32))
        ratio = np.log(likely / chance)[both].sum()
        assert repetition_llr(one, other, codewords) == pytest.approx(ratio, abs=1e-9)


def echoes_of(*steps, known=None):
    """What is a reflection of what, after these time steps."""
    known = Reflections(FORMAT, CODEWORDS) if known is None else known
    for step in steps:
        known.add_detections(step)
    return {k: of for k in range(50) if (of := known.echo_of(k)) is not None}


def test_independent_payloads_are_never_taken_for_one():
    """Two transmitters on one clock with other data: 500 pairs of 100 frames, none is a reflection."""
    rng = np.random.default_rng(2)
    for _ in range(50):
        known = Reflections(FORMAT, CODEWORDS)
        for n in range(100):
            symbols = rng.integers(0, CODEWORDS, (5, 16))
            assert echoes_of([frame(k, n, s, late_us=k) for k, s in enumerate(symbols)], known=known) == {}


@pytest.mark.parametrize(("right", "frames"), [(16, 1), (12, 1), (8, 1), (4, 10)])
def test_the_first_frame_is_enough_where_half_of_it_is_right(right, frames):
    rng = np.random.default_rng(3)
    for _ in range(20):
        images = [frame(1, n, misread(frame_content(n), right, rng), light=70) for n in range(frames)]
        assert echoes_of(*([frame(0, n), image] for n, image in enumerate(images))) == {1: 0}


@pytest.mark.parametrize("clusters", [8, 6])
def test_a_partial_reflection(clusters):
    """Only some clusters of the mirror image are seen: those are compared."""
    part = frame_content(0)
    part[: 16 - clusters] = -1
    assert echoes_of([frame(0, 0), frame(1, 0, part, light=70)]) == {1: 0}
    # As bright as the bar, whichever is first.
    assert echoes_of([frame(0, 0, part), frame(1, 0, frame_content(0))]) == {0: 1}
    # What is hidden of the one is all that is seen of the other: nothing is known.
    rest = np.where(part < 0, frame_content(0), -1)
    assert echoes_of([frame(0, 0, rest), frame(1, 0, part, light=70)]) == {}


def test_frames_at_other_times_are_not_compared():
    known = Reflections(FORMAT, CODEWORDS)
    assert echoes_of(*([frame(0, n), frame(1, n, late_us=60)] for n in range(20)), known=known) == {}
    # The lower of two images is read later: 150 rows of 0.2 us are 30 us.
    lower = frame(2, 20, late_us=75, y_px=450, light=70)
    assert echoes_of([frame(0, 20), lower], known=known) == {2: 0}


@pytest.mark.parametrize(("bar", "road", "rail"), list(permutations(range(3))))
def test_a_bar_with_two_reflections(bar, road, rail):
    """In whatever order they are numbered and come: both are reflections of the bar, none of the other."""
    known = Reflections(FORMAT, CODEWORDS)
    for n in range(3):
        of_road = frame(road, n, late_us=30, y_px=450, light=130, mirrored=True)
        seen = [of_road, frame(bar, n), frame(rail, n, late_us=4, light=72)]
        assert echoes_of(seen[::-1] if n == 1 else seen, known=known) == {road: bar, rail: bar}


def test_two_bars_with_a_reflection_each():
    seen = [frame(k, 0, frame_content(0, seed=k // 2), light=100 - 30 * (k % 2)) for k in range(4)]
    assert echoes_of(seen) == {1: 0, 3: 2}


@pytest.mark.parametrize(("off_px", "found"), [(0.0, {}), (4.0, {}), (6.0, {1: 0})])
def test_one_image_seen_by_two_regions_is_no_reflection(off_px, found):
    seen = ([frame(k, n, x_px=400.0 + off_px * k) for k in (0, 1)] for n in range(10))
    assert echoes_of(*seen) == found


@pytest.mark.parametrize("light", [100.0, 85.0, 50.0, 30.0])
def test_the_verdict_is_stable(light):
    """Frame by frame, now the one has more light, now the other."""
    rng, known, verdicts = np.random.default_rng(5), Reflections(FORMAT, CODEWORDS), []
    for n in range(200):
        other = frame(1, n, light=light * math.exp(rng.normal(0, 0.15)))
        verdicts.append(echoes_of([frame(0, n), other], known=known))
    assert sum(a != b for a, b in pairwise(verdicts)) <= 1
    assert all(verdict == verdicts[10] for verdict in verdicts[10:])
    assert len(verdicts[10]) == 1
    assert light == 100 or verdicts[-1] == {1: 0}


@pytest.mark.parametrize("light", [70, 150, 500])
def test_light_tells_the_bar_unless_one_stands_upside_down(light):
    seen = ([frame(0, n, light=light, mirrored=True), frame(1, n)] for n in range(5))
    assert echoes_of(*seen) == {0: 1}


def test_a_bar_that_appears_after_its_reflection_takes_its_place():
    known = Reflections(FORMAT, CODEWORDS)
    for n in range(12):
        seen = [frame(0, n, light=60, mirrored=True), frame(1, n)]
        assert echoes_of(seen[:1] if n < 10 else seen, known=known) == ({} if n < 10 else {0: 1})
    # A weaker reflection that comes later changes nothing.
    last = [frame(k, 12, light=light) for k, light in enumerate((60, 100, 65))]
    assert echoes_of(last, known=known) == {0: 1, 2: 1}


def test_a_reflection_outlives_its_bar_by_a_second():
    known = Reflections(FORMAT, CODEWORDS)
    for n in range(401):
        image = frame(1, n, light=70)
        # The bar is in sight at first, and again at the end.
        seen = [frame(0, n), image] if n in (0, 400) else [image]
        after_us = image.t_us - frame(1, 0).t_us
        assert echoes_of(seen, known=known) == ({1: 0} if after_us <= 1e6 or n == 400 else {})


def test_memory_is_bounded():
    known = Reflections(FORMAT, CODEWORDS)
    for n in range(2000):
        known.add_detections([frame(k, n, frame_content(n, seed=k), late_us=k) for k in (0, 1, 2 + n // 50)])
        assert sum(map(len, known._seen.values())) <= 4 * (3 * FORMAT.frames + 1)
        assert len(known._pairs) <= 3 + 2 * 8


@pytest.mark.parametrize(("share", "farther_m"), [(None, 0.0), (None, 12.0), (0.25, 0.0)])
def test_two_bars_that_one_controller_feeds(share, farther_m):
    """Both are given, and the image that a rail shows of the one is that of either."""
    fed = {"seed": 3, "start_chip": 120.0, "ppm": 20.0}
    rail = {"kind": "rail", "bar": 0, "share": share, "gap_m": 0.6}
    scene = {
        "duration_s": 0.08,
        "motion": {"distance_m": 50.0},
        "bars": [fed | {"x_m": -1.5}, fed | {"x_m": 2.5, "z_m": farther_m}],
        "reflections": [rail] if share else [],
    }
    receiver, packets = receive_cut(LINK, Events.concat(list(evlcp.simulate(scene, seed=4).chunks())))
    sides = [[f for f in frames_of(packets) if (f.x_px > 640) == right] for right in (False, True)]
    given = [[f for f in side if f.echo_of is None] for side in sides]
    assert [len(side) for side in given] == [23, 23]
    assert len(sides[0]) == len(given[0]) * (2 if share else 1)
    assert receiver.counts["frames_alike"] == sum(map(len, given))
