"""What looks wrong is said, and nothing of what looks right."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.typing import NDArray

from evlcp_sdk.diagnosis.checks import run_checks
from evlcp_sdk.diagnosis.facts import Diagnostic, Facts
from evlcp_sdk.diagnosis.probe import find_other_codewords
from evlcp_sdk.diagnosis.readout import ReadoutTally
from evlcp_sdk.diagnosis.tallies import PositionTally, RunTally
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.place.navigator import Navigator, PositionPlan
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.source import Loss
from evlcp_sdk.values import Events, Frame, Packet, Range, SoftSymbols

LINK = load_link()
NO_POSITIONS = PositionTally().to_dict(Navigator(LINK, PositionPlan(())))


def tally_of(symbols, *, ppm=0.0, every_us=0.0, start_us=0.0, **of_frame: Any) -> RunTally:
    """Packets of ten frames with these symbols, (packets, 10, 16)."""
    tally = RunTally(LINK.packet)
    period_us = LINK.packet.packet_chips * 100.0 / (1 + ppm * 1e-6)
    unknown = np.zeros((16, 6), np.float32)
    for n, packet in enumerate(symbols):
        at_us = start_us + n * period_us
        frames = [
            Frame(0, n, f, at_us + f * every_us, SoftSymbols(one, unknown, 1.0), NEAR, None, 0.0, 0.0)
            for f, one in enumerate(packet)
        ]
        frames = [replace(frame, **of_frame) for frame in frames]
        tally.add(Packet(0, n, at_us, 100.0, tuple(frames), 10))
    return tally


def find(facts: Facts, *verdicts: str) -> list[Diagnostic]:
    return [one for one in run_checks(facts) if one.verdict in (verdicts or ("doubt", "fail"))]


NEAR, NONE = Range(50.0, 0.1, 15), Range(float("nan"), float("nan"), 0)
RANDOM = np.random.default_rng(1).integers(0, 64, (6, 10, 16))
HIDDEN = RANDOM.copy()
HIDDEN[:, :, [4, 12]] = -1
HIDDEN[:3, :, 7] = -1
AT_50_M = 400 + LINK.camera.focal_px * LINK.bar.cluster_centres_m() / 50
HEAD_DOWN, LYING = 800 - AT_50_M, AT_50_M[:, ::-1]
FOUND, NOTHING = tally_of(RANDOM), RunTally(LINK.packet)
UNREAD = {"blocks_tried": 6, "blocks_failed": 6}
READ = {"frames": 60, "blocks_tried": 6, "blocks_decoded": 4, "blocks_failed": 2}
"""Most packets are read, so that the link is right."""
BLINKS = {"events_in_regions": 5_000_000, "regions_opened": 1}
BLINKING = "something blinks, 5,000,000 events in 1 region, but no"


def readout_of(t_us: NDArray[np.int64], y: NDArray[np.int64] | int = 0, pieces: int = 7) -> ReadoutTally:
    tally = ReadoutTally()
    for part in np.array_split(np.stack([t_us, t_us * 0 + y]), pieces, 1):
        tally.add(Events.of(part[0], part[0] * 0, part[1], part[0] * 0))
    return tally


@pytest.mark.parametrize(
    ("tally", "counts", "message"),
    [
        (NOTHING, {}, ""),
        (FOUND, {"frames": 60, "frames_rejected": 6, "blocks_tried": 6, "blocks_decoded": 1}, ""),
        (FOUND, {"frames": 60, "frames_rejected": 20}, "20 of 80 frames rejected"),
        (FOUND, READ | {"frames_rejected": 20}, ""),
        (FOUND, READ | {"frames_rejected": 30}, "30 of 90 frames rejected"),
        (FOUND, {"frames": 60, "frames_unread": 20}, "20 of 80 frames show their clusters, but not one"),
        # A truck before it is no fault of the link's.
        (FOUND, {"frames": 60, "frames_dark": 60, "frames_rejected": 6, "frames_unread": 6}, ""),
        # Random symbols are no blocks; packets that repeat one another are.
        (FOUND, UNREAD, ""),
        (FOUND, UNREAD | {"blocks_alike": 4}, "none of 6 packets with a block that can be read, though 4"),
        (FOUND, READ | {"blocks_other_codebook": 1}, "1 packet sent with another codebook"),
        (FOUND, {"frames": 60, "frames_askew": 40}, "40 of 60 frames show bars that do not stand plumb"),
        # Of bars that one controller feeds: symbols are symbols, unless messages or positions are asked for.
        (FOUND, {"frames": 60, "frames_alike": 60}, ""),
        (FOUND, {"frames": 60, "frames_inverted": 50}, "50 of 60 frames fit only a light that is on where"),
        (FOUND, {"frames": 60, "frames_inverted": 20}, ""),
        # Of a bar that another link reads.
        (FOUND, {"frames": 60, "frames_inverted": 90, "frames_of_others": 90}, ""),
        (
            FOUND,
            {"frames": 60, "events_in_regions": 1000, "events_in_regions_on": 10},
            "990 of 1000 events are OFF: when the light goes on is not seen",
        ),
        (FOUND, {"frames": 60, "events_in_regions": 1000, "events_in_regions_on": 100}, ""),
        (
            FOUND,
            {"frames": 60, "dropped_crowded": 7, "frames_cut": 3, "steps_forgotten": 50},
            "more than the receiver holds at a time: 7 events of crowded time steps dropped; 3 frames",
        ),
        (NOTHING, BLINKS | {"preambles": 0}, f"{BLINKING} preamble is"),
        (NOTHING, BLINKS | {"preambles": 1}, ""),
        (NOTHING, {"events_in_regions": 20_000, "regions_opened": 3, "preambles": 0}, ""),
        # Of a framing that has no preamble.
        (NOTHING, BLINKS | {"frames": 0}, f"{BLINKING} frame is"),
        (NOTHING, {"events": 1_000_000, "dropped_backward": 900}, ""),
        (
            NOTHING,
            {"events": 50_000, "dropped_backward": 90, "dropped_off_sensor": 20},
            "110 events or words dropped (90 backward, 20 off sensor)",
        ),
        (tally_of(RANDOM, ppm=100), {}, ""),
        # Of one packet, a dozen codewords are missing by chance.
        (tally_of(RANDOM[:1]), {}, ""),
        (tally_of(RANDOM % 16), {}, "transmitter 0: 48 of 64 codewords never occur in 960 symbols"),
        # Symbols beyond those that carry data alone.
        (tally_of(RANDOM * 0 + 64), {}, "transmitter 0: 64 of 64 codewords never occur"),
        (tally_of(RANDOM, ppm=-5000), {}, "transmitter 0: its clock is -5000 ppm off"),
        (tally_of(RANDOM, ppm=600), {}, "air.chip_rate_hz = 10006 would fit"),
        # Two packets: 40 us that light took, in 34.6 ms, are no clock.
        (tally_of(RANDOM[:2], ppm=1150), {}, ""),
        (tally_of(RANDOM[:2], ppm=1800), {}, "ppm off the link's"),
        (tally_of(HIDDEN), {}, "transmitter 0: clusters never seen: 4, 12: "),
        (tally_of(RANDOM, points_px=AT_50_M), {}, ""),
        (tally_of(RANDOM, points_px=400 + (AT_50_M - 400) * 0.8), {}, "its distances are 20% too short for"),
        (tally_of(RANDOM, points_px=LYING), {}, ""),
        (tally_of(RANDOM, points_px=HEAD_DOWN), {}, "its clusters stand the other way round"),
        # What is known to be a reflection may be anything; in a wet road it stands on its head.
        (tally_of(RANDOM % 16, ppm=5000, echo_of=3), {}, ""),
        (tally_of(RANDOM, points_px=HEAD_DOWN, echo_of=3), {}, ""),
        (tally_of(RANDOM, range=NONE), {}, "0 of 60 frames have a distance"),
        # What there was no time for is no fault of the bar's.
        (tally_of(RANDOM, range=NONE), {"frames_not_ranged": 60}, ""),
    ],
)
def test_what_counts_and_frames_say(tally: RunTally, counts: dict[str, int], message: str) -> None:
    lines = [str(one) for one in find(Facts(LINK, tally, counts))]
    assert len(lines) == bool(message)
    assert not message or message in lines[0]


STEPS = "times come in steps of {} ms; a chip is 0.1 ms"
NONE_READ = "none of 6 packets with a block that can be read"
FLOODED = {"events": 0, "frames": 40, "frames_flooded": 2}


@pytest.mark.parametrize(
    ("verdict", "given", "message"),
    [
        ("doubt", {"losses": [Loss(200, 0, "byte", "odd")]}, "200 events or words dropped (200 in the file)"),
        ("doubt", {"step_us": 30}, STEPS.format(0.03)),
        ("doubt", {"step_us": 25}, ""),
        ("doubt", {"readout": readout_of(np.arange(0, 10_000, 65))}, STEPS.format(0.065)),
        ("doubt", {"readout": readout_of(np.arange(0, 10_000, 25))}, ""),
        # Two events so far apart say nothing.
        ("doubt", {"readout": readout_of(np.array([0, 500]))}, ""),
        ("note", {"tally": FOUND, "counts": UNREAD}, f"no messages: {NONE_READ}"),
        ("note", {"tally": FOUND, "counts": UNREAD, "reads_messages": False}, ""),
        ("note", {"counts": {"events": 9}}, "no frame was read"),
        ("note", {"counts": {"events": 0}}, ""),
        ("note", {"counts": FLOODED}, "no symbol in 2 of 40 frames, as all light changed in them"),
    ],
)
def test_what_is_reported_of_a_recording(verdict: str, given: dict[str, Any], message: str) -> None:
    facts = Facts(**{"link": LINK, "tally": NOTHING, "counts": {"events": 50_000}} | given)
    assert [one.text for one in find(facts, verdict)] == [message] * bool(message)


def test_bars_that_say_the_same_are_uncertain_where_it_matters_which_is_which() -> None:
    counts = {"events": 50_000, "frames_alike": 40}
    for positions, verdict in ({}, "note"), (NO_POSITIONS | {"fixes": 5}, "doubt"):
        found = find(Facts(LINK, NOTHING, counts, positions=positions), verdict)
        assert [one.code for one in found].count("same-symbols") == 1


@pytest.mark.parametrize(
    ("figures", "decoded", "message"),
    [
        ({"beacon_m": LINK.bar.length_m * 1.001}, 0, ""),
        ({"beacon_m": LINK.bar.length_m * 1.25}, 0, "its distances are 20% too short if the beacon is right"),
        ({"quality_sum": 0.75 * 60}, 0, ""),
        ({"quality_sum": 0.3 * 60}, 0, "70% of its frames have a symbol that is wrong"),
        # Who sends some blocks is expected to send all; what another one sends may be no blocks.
        ({"packets": 30, "blocks": 10}, 10, "20 of 30 packets cannot be read"),
        ({"packets": 30, "blocks": 20}, 20, ""),
        ({"packets": 30, "blocks": 0}, 0, ""),
    ],
)
def test_what_the_figures_of_a_transmitter_say(figures: dict[str, Any], decoded: int, message: str) -> None:
    tally = tally_of(RANDOM)
    for name, value in figures.items():
        setattr(tally.transmitters[0], name, value)
    counts = {"blocks_tried": 60, "blocks_decoded": decoded, "blocks_failed": 60 - decoded}
    found = find(Facts(LINK, tally, counts))
    assert [(message in one.text, one.transmitter) for one in found] == [(True, 0)] * bool(message)


@pytest.mark.parametrize(
    ("off_px", "message"),
    [
        ({2: -0.7, 9: 0.6}, "(their sigma 0.1 m): clusters 2, 10 by up to 0.70 px, 0.5 cm at the bar"),
        (dict(enumerate(np.sin(np.arange(15) / 2))), "neighbours alike"),
        ({2: 0.1, 9: 0.1}, ""),
        ({}, ""),
    ],
)
def test_a_bent_image(off_px: dict[int, float], message: str) -> None:
    """Boundary 2, between clusters 2 and 3, is up the bar: cluster 2 lacks light."""
    off_straight_px = np.zeros(15)
    off_straight_px[list(off_px)] = list(off_px.values())
    off_straight_px[5] = np.nan
    tally = tally_of(RANDOM, range=Range(50.0, 0.1, 15, distortion_px=off_straight_px))
    found = find(Facts(LINK, tally, {}))
    assert [(doubt.code, message in doubt.text) for doubt in found] == [("image-bent", True)] * bool(message)
    # In a few of its frames.
    tally.transmitters[0].distorted_frames = 9
    assert not find(Facts(LINK, tally, {}))


def test_the_modulation_that_was_sent() -> None:
    """Symbols that are all of wh8, read as those of wh4x2: of 64 words of 8 values 16 are words of wh8."""
    ours = LINK.codebook.codewords.tolist()
    theirs = load_link(overrides=["modulation.id=wh8"]).codebook.codewords.tolist()
    inside = np.array([i for i, word in enumerate(ours) if word in theirs])
    assert len(inside) == 16
    sent = inside[np.random.default_rng(2).integers(0, 16, (6, 10, 16))]
    others = partial(find_other_codewords, LINK, Registry.load())
    counts = {"blocks_tried": 9, "blocks_failed": 9}
    (doubt,) = find(Facts(LINK, tally_of(sent), counts, other_codewords=others))
    assert (doubt.code, doubt.transmitter) == ("profile", 0)
    assert doubt.text == "only 16 of 64 symbols ever occur, 9 of 9 blocks unreadable"
    assert doubt.next_step == "was this sent with wh8? try --set modulation.id=wh8"
    # The link of a program may be of plugins that this registry lacks.
    assert find_other_codewords(LINK, Registry()) == {}
    # Of values that wh8 has, and as many others.
    rest = np.setdiff1d(np.arange(64), inside)[:16]
    mixed = np.concatenate([inside, rest])[np.random.default_rng(2).integers(0, 32, (6, 10, 16))]
    # Or all the same, which every modulation has.
    for symbols in (mixed, sent * 0):
        (doubt,) = find(Facts(LINK, tally_of(symbols), {}, other_codewords=others))
        assert doubt.code == "codewords"


@pytest.mark.parametrize(
    ("start_us", "lit_us", "expected"),
    [
        (17e3, (17e3, 1.0e6), "nothing after 214 ms, though its light is there until 995 ms"),
        (717e3, (45e3, 9e5), "nothing before 712 ms, though its light is there from 40 ms on"),
        (17e3, (17e3, 3e5), None),
        (17e3, None, None),
    ],
)
def test_light_without_frames(
    start_us: float, lit_us: tuple[float, float] | None, expected: str | None
) -> None:
    """Six packets of 34.6 ms, the last frame 31.4 ms before their end, in a recording of a second."""
    tally = tally_of(RANDOM, every_us=3200.0, start_us=start_us)
    facts = Facts(LINK, tally, {}, 5e3, 1.005e6, None if lit_us is None else {0: lit_us})
    found = find(facts)
    assert [doubt.code for doubt in found] == ["coverage"] * (expected is not None)
    assert expected is None or found[0].text == expected
    # Where nothing is received is said in any case, but a road without bars is nothing wrong.
    (note,) = find(facts, "note")
    ms = round((start_us - 5e3) / 1e3)
    assert note.text == f"frames in 208 ms of 1000 ms: nothing before {ms} ms, nothing after {ms + 202} ms"
    assert find(replace(facts, last_us=3e5), "note") == []
    # A reflection may be lit without a frame.
    mirrored = tally_of(RANDOM, every_us=3200.0, start_us=start_us, echo_of=3)
    assert find(replace(facts, tally=mirrored)) == []


@pytest.mark.parametrize("rows", [40, 95])
@pytest.mark.parametrize("rests", [True, False])
def test_a_sensor_that_comes_to_each_row_too_late(rows: int, rests: bool) -> None:
    """A row a microsecond, without rest or for a part of each millisecond, 40 us or 95 from row to row."""
    t_us = np.repeat(np.arange(100_000), 2)
    y = 300 + t_us % rows
    if rests:
        used = t_us % 1000 < np.random.default_rng(5).integers(500, 1000, 100)[t_us // 1000]
        t_us, y = t_us[used], y[used]
    readout = readout_of(t_us, y)
    assert readout.round_us() == ((0.0, 0.0) if rests else pytest.approx((1, rows), rel=0.03))
    found = find(Facts(LINK, FOUND, {"frames": 60}, 0.0, 1e5, readout=readout))
    late = [doubt.text for doubt in found if doubt.code == "readout"]
    assert len(late) == (rows == 95 and not rests)
    assert all("1 us a row" in text and "chips: changes" in text for text in late)


@given(st.lists(st.integers(0, 3_000), min_size=1, max_size=300), st.integers(1, 9))
def test_events_of_each_millisecond(steps: list[int], pieces: int) -> None:
    """Against NumPy's count of the milliseconds that are over."""
    t_us = np.cumsum(steps) * 7
    many = np.unique(t_us // 1000, return_counts=True)[1][:-1]
    share, most = readout_of(t_us, 0, pieces).events.measure_cap()
    assert most == pytest.approx(many.max(initial=0), rel=0.004)
    if most < 100:
        assert share == pytest.approx((many == many.max()).mean() if len(many) else 0.0)


def learnt(part: str, what: str, off: float, sigma: float) -> dict[str, Any]:
    """Positions of a drive that shows an error of something of which a sigma of 0.2 is stated."""
    row = {"part": part, "what": what, "correction": off, "sigma": sigma, "stated_sigma": 0.2}
    return {"fixes": 1, "learnt": [row | {"determined": sigma < 0.18}]}


def misfit(suspects: dict[str, int], fits_mm: float | None = None) -> dict[str, Any]:
    """Ten positions refused, with what would explain some of them."""
    return {"refused": {"misfit": 10}, "suspects": suspects, "focal_mm_fits": fits_mm}


NO_SITE = {"refused": {"no-site": 4}, "heard": {"0": 9, "1": 7, "2": 9}}


def positions_beside(strange: list[int], unseen: list[int]) -> dict[str, Any]:
    """Positions of a bar with the id 7, beside others that are in no site, and sites that are not seen."""
    reported = {str(number): one for number, one in enumerate([7, *strange])}
    return {"fixes": 9, "bars": {"0": 7}, "heard": reported, "sites_unseen": unseen}


@pytest.mark.parametrize(
    ("code", "positions", "message"),
    [
        ("no-site", NO_SITE, "received: ids 7, 9: compare"),
        # A bar more beside those that are known is none.
        ("no-site", NO_SITE | {"fixes": 9}, ""),
        (
            "unknown-id",
            positions_beside([107], [8]),
            "without id 107, received and in no site; id 8 of the sites",
        ),
        (
            "unknown-id",
            positions_beside([9, 4], [1, 2]),
            "without ids 4, 9, received and in no site; ids 1, 2 of the",
        ),
        ("unknown-id", positions_beside([107], []), ""),
        ("unknown-id", positions_beside([], [8]), ""),
        ("misfit", misfit({"heading": 9, "bar 1": 2}), "another heading would explain it: compare"),
        ("misfit", misfit({"focal length": 10, "bar 0": 6}, 34.6), "another focal length or another bar 0"),
        (
            "misfit",
            misfit({"bar 0": 10}, 51.2),
            "another focal length or another bar 0 would explain it: compare camera.focal_mm = 35: about 51.2"
            " would fit; place, angles and length of bar 0",
        ),
        ("focal", learnt("camera", "focal_mm", 0.1, 0.02), "a focal length of 35.1 +- 0.02 mm, not 35"),
        ("focal", learnt("camera", "focal_mm", 0.05, 0.02), ""),
        ("learnt", learnt("bar 2", "east_m", 0.4, 0.02), ""),
        ("learnt", learnt("bar 2", "east_m", -0.9, 0.02), "shows bar 2, east_m, -0.9 off what is stated,"),
        ("excluded", {"fixes": 2, "excluded": {"heading": 2}}, "2 positions without heading, which the rest"),
        (
            "excluded",
            {"fixes": 2, "excluded": {"bar 1": 1}, "focal_mm_fits": 34.6},
            "1 position without bar 1, which the rest contradicts: compare camera.focal_mm = 35: about 34.6"
            " would fit; or its place, angles and length",
        ),
        ("attitude-outside", {"fixes": 1, "attitude_outside": 9}, "none of the attitude's 9 lines is within"),
        ("attitude-missing", {"fixes": 5, "attitude_missing": 2}, "2 of 5 positions have no attitude"),
        ("gnss-outside", {"gnss_outside": 3}, "none of 3 GNSS fixes is within the recording's time"),
        ("gnss-without-heading", {"fixes": 1, "gnss_without_heading": 1}, "1 GNSS fix not used, as no"),
    ],
)
def test_what_positions_say(code: str, positions: dict[str, Any], message: str) -> None:
    link = load_link(overrides=["camera_sigma.focal_mm=0.2"])
    found = find(Facts(link, NOTHING, {}, positions=NO_POSITIONS | positions))
    assert [message in str(one) for one in found if one.code == code] == [True] * bool(message)
