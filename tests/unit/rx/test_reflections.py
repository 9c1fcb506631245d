"""Which transmitter is the reflection of which: the evidence, the decision, and the receiver."""

import math
from dataclasses import replace
from functools import cache
from itertools import pairwise, permutations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.rx.grid import PacketGrid
from evlcp_sdk.rx.packets import PacketAssembler
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.rx.reflections import (
    FrameDetection,
    ReflectionQueue,
    Reflections,
    brighter,
    originals,
    repeats,
)
from evlcp_sdk.testing.recordings import IdealBar, ideal_events, merged, random_symbols
from evlcp_sdk.values import Events, Frame, Packet, Range, SoftSymbols, SyncLock

FORMAT = PacketFormat()
PERIOD_US = FORMAT.packet_chips * FORMAT.chip_us
CODEWORDS = 64
Symbols = NDArray[np.int64]


def sighting(
    transmitter: int,
    number: int,
    symbols: Symbols,
    *,
    late_us: float = 0.0,
    y_px: float = 300.0,
    x_px: float | None = None,
    light: float = 100.0,
    mirrored: bool = False,
) -> FrameDetection:
    """The frame of a number since the start."""
    packet, index = divmod(number, FORMAT.frames)
    t_us = packet * PERIOD_US + FORMAT.frame_start_chip(index) * FORMAT.chip_us + late_us
    soft = SoftSymbols(symbols, np.zeros((len(symbols), 6), np.float32), 1.0)
    none = Range(math.nan, math.nan, 0)
    x_px = 400.0 + 40 * transmitter if x_px is None else x_px
    frame = Frame(transmitter, packet, index, t_us, soft, none, None, x_px, y_px)
    return FrameDetection(frame, t_us, light, int((symbols >= 0).sum()), mirrored)


def said(number: int, seed: int = 0) -> Symbols:
    """What a frame says."""
    return np.random.default_rng((seed, number)).integers(0, CODEWORDS, 16)


def misread(symbols: Symbols, right: int, rng: np.random.Generator) -> Symbols:
    """Symbols of which so many are right, at random places."""
    wrong = rng.permutation(len(symbols))[right:]
    found = symbols.copy()
    found[wrong] = (found[wrong] + rng.integers(1, CODEWORDS, len(wrong))) % CODEWORDS
    return found


@pytest.mark.parametrize(("codewords", "clusters"), [(64, 16), (16, 16), (256, 16), (64, 2), (2, 16)])
def test_evidence_is_the_likelihood_ratio_of_the_two_models(codewords: int, clusters: int) -> None:
    """Of models in which a share of the symbols is repeated and the rest drawn, case by case."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        one, other = rng.integers(-1, min(codewords, 4), (2, clusters))
        ratio = 0.0
        for a, b in zip(one, other, strict=True):
            if a >= 0 and b >= 0:
                likely = [share * (a == b) + (1 - share) / codewords for share in (1 / 4, 1 / 32)]
                ratio += math.log(likely[0] / likely[1])
        assert repeats(one, other, codewords) == pytest.approx(ratio, abs=1e-9)


def test_independent_payloads_are_never_taken_for_one() -> None:
    """Two transmitters on one clock with other data: 2,000 pairs of 100 frames, none is a reflection."""
    rng = np.random.default_rng(2)
    for _ in range(200):
        echoes = Reflections(FORMAT, CODEWORDS)
        for n in range(100):
            symbols = rng.integers(0, CODEWORDS, (5, 16))
            echoes.judge(sighting(k, n, s, late_us=k) for k, s in enumerate(symbols))
            assert not any(echoes.echo_of(k) is not None for k in range(5))


@pytest.mark.parametrize("right", [16, 12, 8])
def test_the_first_frame_is_enough(right: int) -> None:
    rng = np.random.default_rng(3)
    echoes = Reflections(FORMAT, CODEWORDS)
    echoes.judge([sighting(0, 0, said(0)), sighting(1, 0, misread(said(0), right, rng), light=70)])
    assert (echoes.echo_of(0), echoes.echo_of(1)) == (None, 0)


def test_a_reflection_of_which_most_is_misread_is_found_within_a_packet() -> None:
    rng = np.random.default_rng(4)
    for _ in range(50):
        echoes = Reflections(FORMAT, CODEWORDS)
        for n in range(10):
            echoes.judge([sighting(0, n, said(n)), sighting(1, n, misread(said(n), 4, rng), light=70)])
        assert echoes.echo_of(1) == 0


@pytest.mark.parametrize("clusters", [8, 6])
def test_a_partial_reflection(clusters: int) -> None:
    """Only some clusters of the mirror image are seen: those are compared."""
    part = said(0)
    part[: 16 - clusters] = -1
    echoes = Reflections(FORMAT, CODEWORDS)
    echoes.judge([sighting(0, 0, said(0)), sighting(1, 0, part, light=70)])
    assert echoes.echo_of(1) == 0
    # As bright as the bar, whichever is first.
    echoes = Reflections(FORMAT, CODEWORDS)
    echoes.judge([sighting(0, 0, part), sighting(1, 0, said(0))])
    assert echoes.echo_of(0) == 1
    # What is hidden of the one is all that is seen of the other: nothing is known.
    rest = np.where(part < 0, said(0), -1)
    echoes = Reflections(FORMAT, CODEWORDS)
    echoes.judge([sighting(0, 0, rest), sighting(1, 0, part, light=70)])
    assert echoes.echo_of(1) is None


def test_frames_at_other_times_are_not_compared() -> None:
    echoes = Reflections(FORMAT, CODEWORDS)
    for n in range(20):
        echoes.judge([sighting(0, n, said(n)), sighting(1, n, said(n), late_us=60)])
    assert echoes.echo_of(0) is echoes.echo_of(1) is None
    # The lower of two images is read later: 150 rows of 0.2 us are 30 us.
    echoes.judge([sighting(0, 20, said(20)), sighting(2, 20, said(20), late_us=75, y_px=450, light=70)])
    assert echoes.echo_of(2) == 0


@pytest.mark.parametrize("order", list(permutations(range(3))))
def test_a_bar_with_two_reflections(order: tuple[int, ...]) -> None:
    """In whatever order they were numbered: both are reflections of the bar, none of a reflection."""
    bar, road, rail = order
    echoes = Reflections(FORMAT, CODEWORDS)
    for n in range(3):
        echoes.judge(
            [
                sighting(road, n, said(n), late_us=30, y_px=450, light=130, mirrored=True),
                sighting(bar, n, said(n)),
                sighting(rail, n, said(n), late_us=4, light=72),
            ]
        )
        assert [echoes.echo_of(k) for k in (bar, road, rail)] == [None, bar, bar]


def test_what_comes_late_is_judged_by_what_was_before() -> None:
    """A reflection is heard two packets late: it starts with the frames before its lock."""
    echoes = Reflections(FORMAT, CODEWORDS)
    for n in range(25):
        echoes.judge([sighting(0, n, said(n))])
    echoes.judge([sighting(1, n, said(n), light=70) for n in range(5, 25)])
    assert echoes.echo_of(1) == 0


def test_one_image_seen_by_two_regions_is_no_reflection() -> None:
    for off_px, echo_of in ((0.0, None), (4.0, None), (6.0, 0)):
        echoes = Reflections(FORMAT, CODEWORDS)
        for n in range(10):
            echoes.judge([sighting(0, n, said(n), x_px=400.0), sighting(1, n, said(n), x_px=400.0 + off_px)])
        assert echoes.echo_of(1) == echo_of


def test_the_verdict_is_stable() -> None:
    rng = np.random.default_rng(5)
    for light in (100.0, 85.0, 50.0, 30.0):
        echoes, verdicts = Reflections(FORMAT, CODEWORDS), []
        for n in range(200):
            # Frame by frame, now the one has more light, now the other.
            now = light * math.exp(rng.normal(0, 0.15))
            echoes.judge([sighting(0, n, said(n)), sighting(1, n, said(n), light=now)])
            verdicts.append((echoes.echo_of(0), echoes.echo_of(1)))
        assert sum(a != b for a, b in pairwise(verdicts)) <= 1
        assert len(set(verdicts[10:])) == 1
        if light != 100:
            assert verdicts[-1] == (None, 0)


def test_light_tells_the_bar_unless_one_stands_upside_down() -> None:
    for light in (0.05, 0.3, 3.0):
        assert brighter(light) == -brighter(-light) > 0
    for light in (70, 150, 500):
        echoes = Reflections(FORMAT, CODEWORDS)
        for n in range(5):
            image = sighting(0, n, said(n), light=light, mirrored=True)
            echoes.judge([image, sighting(1, n, said(n))])
            assert (echoes.echo_of(0), echoes.echo_of(1)) == (1, None)


def test_a_bar_that_appears_after_its_reflection_takes_its_place() -> None:
    echoes = Reflections(FORMAT, CODEWORDS)
    for n in range(10):
        echoes.judge([sighting(0, n, said(n), light=60, mirrored=True)])
        assert echoes.echo_of(0) is None
    for n in range(10, 12):
        echoes.judge([sighting(0, n, said(n), light=60, mirrored=True), sighting(1, n, said(n), light=100)])
        assert (echoes.echo_of(0), echoes.echo_of(1)) == (1, None)
    # A weaker reflection that comes later changes nothing.
    echoes.judge([sighting(k, 12, said(12), light=light) for k, light in ((0, 60), (1, 100), (2, 65))])
    assert [echoes.echo_of(k) for k in range(3)] == [1, None, 1]


def test_a_reflection_outlives_its_bar_by_a_second() -> None:
    echoes = Reflections(FORMAT, CODEWORDS)
    echoes.judge([sighting(0, 0, said(0)), sighting(1, 0, said(0), light=70)])
    for n in range(1, 400):
        echoes.judge([sighting(1, n, said(n), light=70)])
        t_us = sighting(1, n, said(n)).frame.t_us - sighting(1, 0, said(0)).frame.t_us
        assert echoes.echo_of(1) == (0 if t_us <= 1e6 else None)
    # It is in sight again.
    echoes.judge([sighting(0, 400, said(400)), sighting(1, 400, said(400), light=70)])
    assert echoes.echo_of(1) == 0


def test_memory_is_bounded() -> None:
    echoes = Reflections(FORMAT, CODEWORDS)
    for n in range(2000):
        echoes.judge([sighting(k, n, said(n, seed=k), late_us=k) for k in (0, 1, 2 + n // 50)])
        assert sum(map(len, echoes._seen.values())) <= 4 * (3 * FORMAT.frames + 1)
        assert len(echoes._pairs) <= 3 + 2 * 8


@given(st.permutations(range(4)), st.integers(0, 100))
@settings(max_examples=40, deadline=None)
def test_the_order_within_a_step_does_not_matter(order: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    found = []
    for way in (range(4), order):
        echoes = Reflections(FORMAT, CODEWORDS)
        rng = np.random.default_rng(seed)
        for n in range(4):
            every = [
                sighting(k, n, misread(said(n), 8, rng), late_us=float(rng.integers(0, 5)), light=100 - k)
                for k in range(4)
            ]
            echoes.judge([every[k] for k in way])
        found.append([echoes.echo_of(k) for k in range(4)])
    assert found[0] == found[1]


def test_originals_against_every_choice() -> None:
    """The one that the pairs favour most, by trying each; whoever was it before has a bonus."""
    rng = np.random.default_rng(6)
    for _ in range(200):
        size = int(rng.integers(2, 5))
        matrix = rng.normal(0, 4, (size, size))
        matrix -= matrix.T
        before = {int(rng.integers(0, size))} if rng.random() < 0.5 else set()
        odds = {(i, j): float(matrix[i, j]) for i in range(size) for j in range(i + 1, size)}
        score = [matrix[i].sum() / 2 + 1.0 * (i in before) for i in range(size)]
        assert originals(range(size), odds, before) == int(np.argmax(score))


def test_the_queue_marks_what_the_next_step_tells() -> None:
    """A bar locks a step after its reflection: the reflection's frames have waited."""
    queue = ReflectionQueue(Reflections(FORMAT, CODEWORDS))
    grid = PacketGrid(FORMAT)
    grid.restart(SyncLock(0.0, FORMAT.chip_us, 0.0, 0.0, 1.0), 0.0)
    due = grid.due(1e9)
    assert due is not None
    bar, image = PacketAssembler(FORMAT.frames), PacketAssembler(FORMAT.frames)
    for n in range(10):
        queue.add(image, due, sighting(0, n, said(n), light=70))
    assert queue.step() == []
    assert queue
    for n in range(10):
        queue.add(bar, due, sighting(1, n, said(n)))
    (packet,) = queue.step()
    assert (packet.transmitter, packet.echo_of) == (0, 1)
    assert {f.echo_of for f in packet.frames} == {1}
    queue.add(image, due, sighting(0, 10, said(10)))
    queue.end(image)
    assert [(p.transmitter, p.echo_of, len(p.frames)) for p in queue.close()] == [(1, None, 10), (0, 1, 1)]
    assert not queue


LINK = load_link()


def reflected(
    link_events: Events, *, right_px: int, down_px: int, missing: float, late_us: int, seed: int = 1
) -> Events:
    """The same events at another place, later, with some of them missing."""
    rng = np.random.default_rng(seed)
    kept = link_events[rng.random(len(link_events)) >= missing]
    return Events.of(kept.t_us + late_us, kept.x + right_px, kept.y + down_px, kept.p)


def rows(packets: list[Packet]) -> list[tuple[int, int, int, int | None, bytes]]:
    return [
        (f.transmitter, f.packet, f.frame, f.echo_of, f.soft.llr.tobytes()) for p in packets for f in p.frames
    ]


def received(events: Events, cuts: list[int] | None = None) -> list[Packet]:
    receiver = Receiver(LINK)
    packets: list[Packet] = []
    edges = [0, *sorted(cuts or []), len(events)]
    for start, end in pairwise(edges):
        packets += receiver.feed(events[start:end])
    packets += receiver.close()
    counts = receiver.counts
    found = sum(len(p.frames) for p in packets)
    assert counts["frames"] == found
    assert counts["frames_reflected"] == sum(len(p.frames) for p in packets if p.echo_of is not None)
    assert counts["packets"] == len(packets)
    return packets


BAR = IdealBar(random_symbols(LINK, 3), shake_px=2.0)
OWN = ideal_events(LINK, BAR)
# A rail is lower than the bar: its image is cut. Nothing else tells events from the same ones, some missing.
SCENE = merged(OWN, reflected(OWN[OWN.y < 370], right_px=80, down_px=20, missing=0.4, late_us=7))


def test_a_rail_shows_the_bar_again() -> None:
    packets = received(SCENE)
    of_bar = [p for p in packets if p.frames[0].x_px < 440]
    of_rail = [p for p in packets if p.frames[0].x_px > 440]
    assert sum(len(p.frames) for p in of_bar) == sum(len(p.frames) for p in of_rail) == 30
    (bar,), (rail,) = ({p.transmitter for p in part} for part in (of_bar, of_rail))
    assert {p.echo_of for p in of_bar} == {None}
    assert {p.echo_of for p in of_rail} == {bar}
    assert bar != rail
    for packet in of_bar:
        assert packet.messages == ()
        assert all(f.echo_of is None for f in packet.frames)


@cache
def whole() -> list[tuple[int, int, int, int | None, bytes]]:
    return rows(received(SCENE))


@given(st.lists(st.integers(0, len(SCENE)), max_size=40))
@settings(max_examples=5, deadline=None)
def test_any_split_gives_the_same(cuts: list[int]) -> None:
    assert rows(received(SCENE, cuts)) == whole()


def test_a_reflection_that_comes_and_goes() -> None:
    """It locks now and then: each time it is a reflection from its first frame on."""
    long = IdealBar(random_symbols(LINK, 7))
    own = ideal_events(LINK, long)
    image = reflected(own, right_px=80, down_px=0, missing=0.4, late_us=5)
    lit = (image.t_us // 60_000) % 2 == 1
    packets = received(merged(own, image[lit]))
    beside = [p for p in packets if p.frames[0].x_px > 440]
    assert sum(len(p.frames) for p in beside) > 20
    assert all(p.echo_of is not None for p in beside)
    assert all(p.echo_of is None for p in packets if p not in beside)


def test_half_a_reflection() -> None:
    """Eight of sixteen clusters are mirrored, weaker than the bar: it is a reflection, or nothing."""
    image = ideal_events(LINK, replace(BAR, x_px=480.3), seed=2, missing=0.2)
    packets = received(merged(OWN, image[image.y > 350]))
    own = [p for p in packets if p.echo_of is None]
    assert {p.frames[0].x_px < 440 for p in own} == {True}
    assert sum(len(p.frames) for p in own) == 30


def test_two_bars_on_one_clock_are_two() -> None:
    other = replace(BAR, symbols=random_symbols(LINK, 3, seed=9), x_px=500.0)
    packets = received(merged(OWN, ideal_events(LINK, other, seed=2)))
    assert len({p.transmitter for p in packets}) == 2
    assert {p.echo_of for p in packets} == {None}


def test_what_was_shown_then_and_there_is_known() -> None:
    echoes = Reflections(FORMAT, CODEWORDS)
    one = sighting(0, 3, said(3), x_px=300.0, y_px=350.0)
    echoes.judge([one])
    t_us = one.frame.t_us
    assert echoes.shown(t_us + 40, (304.0, 350.0))
    assert not echoes.shown(t_us + 60, (304.0, 350.0))
    assert not echoes.shown(t_us + 40, (306.0, 350.0))
