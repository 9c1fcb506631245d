"""What looks wrong is said, and nothing of what looks right."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from evlcp_sdk.diagnosis.facts import Facts, other_codewords
from evlcp_sdk.diagnosis.readout import ReadoutTally
from evlcp_sdk.diagnosis.tallies import RunTally
from evlcp_sdk.diagnosis.warnings import find_notes, find_warnings
from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.values import Events, Frame, Packet, Range, SoftSymbols

LINK = load_link()
NO_POSITIONS = {
    "fixes": 0,
    "refused": {},
    "gnss": 0,
    "gnss_without_heading": 0,
    "gnss_outside": 0,
    "attitude_outside": 0,
    "attitude_missing": 0,
    "gnss_apart_m": None,
    "bars_exact": [],
    "excluded": {},
    "alarms": {},
    "learnt": [],
    "heard": {},
    "bars": {},
    "sites_contradicted": {},
    "sites_unseen": [],
}
NONE = Range(float("nan"), float("nan"), 0)
NEAR = Range(50.0, 0.1, 15)


def tally_of(
    symbols: np.ndarray,
    *,
    ppm: float = 0.0,
    echo_of: int | None = None,
    distance: Range = NEAR,
    every_us: float = 0.0,
    start_us: float = 0.0,
    points: np.ndarray | None = None,
) -> RunTally:
    """Packets of ten frames with these symbols, (packets, 10, 16)."""
    tally = RunTally(LINK.packet)
    period_us = LINK.packet.packet_chips * 100.0 / (1 + ppm * 1e-6)
    more = {} if points is None else {"points_px": points}
    for n, packet in enumerate(symbols):
        at_us = start_us + n * period_us
        frames = tuple(
            Frame(
                0,
                n,
                f,
                at_us + f * every_us,
                SoftSymbols(said, np.zeros((16, 6), np.float32), 1.0),
                distance,
                None,
                0.0,
                0.0,
                **more,
            )
            for f, said in enumerate(packet)
        )
        frames = tuple(replace(frame, echo_of=echo_of) for frame in frames)
        tally.add(Packet(0, n, at_us, 100.0, frames, 10))
    return tally


def told(tally: RunTally, link: Link = LINK, **counts: int) -> list[str]:
    return [str(doubt) for doubt in find_warnings(Facts(link, tally, counts))]


def facts_of(positions: dict[str, Any], link: Link = LINK) -> Facts:
    return Facts(link, RunTally(link.packet), {}, positions=positions)


RANDOM = np.random.default_rng(1).integers(0, 64, (6, 10, 16))


def test_what_is_right_is_not_doubted() -> None:
    assert (
        told(tally_of(RANDOM, ppm=100), frames=60, frames_rejected=6, blocks_tried=6, blocks_decoded=1) == []
    )
    assert told(RunTally(LINK.packet)) == []
    # Of one packet, a dozen codewords are missing by chance.
    assert len(np.unique(RANDOM[0])) < 64
    assert told(tally_of(RANDOM[:1])) == []


def test_codewords_that_never_occur() -> None:
    (line,) = told(tally_of(RANDOM % 16))
    assert line.startswith("transmitter 0: 48 of 64 codewords never occur in 960 symbols")
    assert line.endswith("another modulation than modulation.id")
    # Symbols beyond those that carry data alone.
    (line,) = told(tally_of(RANDOM * 0 + 64))
    assert "64 of 64 codewords never occur" in line


@pytest.mark.parametrize("ppm", [-5000.0, 600.0])
def test_a_clock_that_no_crystal_has(ppm: float) -> None:
    (line,) = told(tally_of(RANDOM, ppm=ppm))
    assert f"{ppm:+.0f} ppm off" in line
    assert f"air.chip_rate_hz = {10_000 + ppm / 100:.6g} would fit" in line


def test_a_short_recording_says_little_of_a_clock() -> None:
    # Two packets: 40 us that light took, in 34.6 ms, are no clock.
    assert told(tally_of(RANDOM[:2], ppm=1150)) == []
    assert len(told(tally_of(RANDOM[:2], ppm=1800))) == 1


def test_clusters_that_are_never_seen() -> None:
    hidden = RANDOM.copy()
    hidden[:, :, [4, 12]] = -1
    hidden[:3, :, 7] = -1
    (line,) = told(tally_of(hidden))
    assert line.startswith("transmitter 0: clusters never seen: 4, 12: ")


def test_frames_rejected_and_blocks_that_cannot_be_read() -> None:
    (line,) = told(tally_of(RANDOM), frames=60, frames_rejected=20)
    assert line.startswith("20 of 80 frames rejected")
    # Where most packets are read, the link is right.
    blocks = {"blocks_tried": 6, "blocks_decoded": 4, "blocks_failed": 2}
    assert told(tally_of(RANDOM), frames=60, frames_rejected=20, **blocks) == []
    (line,) = told(tally_of(RANDOM), frames=60, frames_rejected=30, **blocks)
    assert line.startswith("30 of 90 frames rejected")
    (line,) = told(tally_of(RANDOM), frames=60, frames_unread=20)
    assert line.startswith("20 of 80 frames show their clusters, but not one symbol")
    # A truck before it is no fault of the link's.
    assert told(tally_of(RANDOM), frames=60, frames_dark=60, frames_rejected=6, frames_unread=6) == []


def test_blocks_are_doubted_where_there_is_something_to_read() -> None:
    # Random symbols are no blocks: that is said plainly.
    random = {"blocks_tried": 6, "blocks_failed": 6}
    assert find_warnings(Facts(LINK, tally_of(RANDOM), random)) == []
    (note,) = find_notes(Facts(LINK, tally_of(RANDOM), random))
    assert (note.code, str(note)) == (
        "no-messages",
        "no messages: none of 6 packets has a block that can be read",
    )
    assert find_notes(Facts(LINK, tally_of(RANDOM), random, reads_messages=False)) == []
    # Packets that repeat one another are.
    (line,) = told(tally_of(RANDOM), blocks_tried=6, blocks_failed=6, blocks_alike=4)
    assert line.startswith("none of 6 packets has a block that can be read, though 4 of them repeat others")
    assert "error-correction.id" in line
    (line,) = told(tally_of(RANDOM), blocks_tried=6, blocks_decoded=5, blocks_other_codebook=1)
    assert line.startswith("1 packet sent with another codebook")


@pytest.mark.parametrize(("packets", "blocks", "said"), [(30, 10, True), (30, 20, False), (30, 0, False)])
def test_a_transmitter_that_sends_some_blocks_is_expected_to_send_all(
    packets: int, blocks: int, said: bool
) -> None:
    """What another one sends, beside it, may be symbols that are no blocks."""
    tally = tally_of(RANDOM)
    tally.transmitters[0].packets, tally.transmitters[0].blocks = packets, blocks
    lines = told(tally, blocks_tried=60, blocks_decoded=blocks, blocks_failed=60 - blocks)
    assert ["transmitter 0: 20 of 30 packets cannot be read" in line for line in lines] == [True] * said


def test_the_modulation_that_was_sent() -> None:
    """Symbols that are all of wh8, read as those of wh4x2: of 64 words of 8 values 16 are words of wh8."""
    ours = LINK.codebook.codewords.tolist()
    theirs = load_link(overrides=["modulation.id=wh8"]).codebook.codewords.tolist()
    inside = np.array([i for i, word in enumerate(ours) if word in theirs])
    assert len(inside) == 16
    sent = inside[np.random.default_rng(2).integers(0, 16, (6, 10, 16))]
    others = partial(other_codewords, LINK, Registry.load())
    counts = {"blocks_tried": 9, "blocks_failed": 9}
    (doubt,) = find_warnings(Facts(LINK, tally_of(sent), counts, others=others))
    assert (doubt.code, doubt.transmitter) == ("profile", 0)
    assert doubt.text == "only 16 of 64 symbols ever occur, 9 of 9 blocks unreadable"
    assert doubt.next_step == "was this sent with wh8? try --set modulation.id=wh8"
    noisy = np.where(np.random.default_rng(3).random(sent.shape) < 0.02, RANDOM, sent)
    (doubt,) = find_warnings(Facts(LINK, tally_of(noisy), {}, others=others))
    assert doubt.code in ("profile", "codewords") or len(np.unique(noisy)) == 64
    # All the same, which every modulation has.
    (doubt,) = find_warnings(Facts(LINK, tally_of(sent * 0), {}, others=others))
    assert doubt.code == "codewords"


@pytest.mark.parametrize(
    ("start_us", "lit_us", "says"),
    [
        (17e3, (17e3, 1.0e6), "nothing after 214 ms, though its light is there until 995 ms"),
        (717e3, (45e3, 9e5), "nothing before 712 ms, though its light is there from 40 ms on"),
        (17e3, (17e3, 3e5), None),
        (17e3, None, None),
    ],
)
def test_light_without_frames(start_us: float, lit_us: tuple[float, float] | None, says: str | None) -> None:
    """Six packets of 34.6 ms, the last frame 31.4 ms before their end, in a recording of a second."""
    tally = tally_of(RANDOM, every_us=3200.0, start_us=start_us)
    facts = Facts(LINK, tally, {}, 5e3, 1.005e6, None if lit_us is None else {0: lit_us})
    found = find_warnings(facts)
    assert [doubt.code for doubt in found] == ["coverage"] * (says is not None)
    assert says is None or found[0].text == says
    # Where nothing is received is said in any case, but a road without bars is nothing wrong.
    (note,) = find_notes(facts)
    first_ms = round((start_us - 5e3) / 1e3)
    assert note.text == (
        f"frames in 208 ms of 1000 ms: nothing before {first_ms} ms, nothing after {first_ms + 202} ms"
    )
    assert find_notes(replace(facts, last_us=3e5)) == []


def test_distances_that_the_size_contradicts() -> None:
    centres_m = LINK.bar.cluster_centres_m()
    at_50_m = 400 + LINK.camera.focal_px * centres_m / 50
    assert told(tally_of(RANDOM, points=at_50_m)) == []
    (line,) = told(tally_of(RANDOM, points=400 + (at_50_m - 400) * 0.8))
    assert line.startswith("transmitter 0: its distances are 20% too short for a bar of")
    (line,) = told(tally_of(RANDOM, points=400 + (at_50_m - 400) * 1.5))
    assert "50% too long" in line


def test_a_beacon_that_says_another_length() -> None:
    tally = tally_of(RANDOM)
    tally.transmitters[0].beacon_m = LINK.bar.length_m * 1.001
    assert told(tally) == []
    tally.transmitters[0].beacon_m = LINK.bar.length_m * 1.25
    (line,) = told(tally)
    assert "its distances are 20% too short if the beacon is right" in line


def test_a_readout_at_its_limit() -> None:
    """3000 events in each millisecond, against 3000 on average, and a lamp that blinks evenly."""
    rng = np.random.default_rng(4)
    for many, capped in (
        (np.full(300, 3000), True),
        (rng.poisson(3000, 300), False),
        (rng.poisson(20, 300), False),
        (np.full(300, 20), False),
    ):
        t_us = np.sort(np.concatenate([1000 * i + rng.integers(0, 1000, n) for i, n in enumerate(many)]))
        readout = ReadoutTally()
        for piece in np.array_split(t_us, 7):
            readout.add(Events.of(piece, piece * 0, piece * 0, piece * 0))
        found = find_warnings(Facts(LINK, RunTally(LINK.packet), {}, 0.0, 3e5, readout=readout))
        assert [doubt.code for doubt in found] == ["saturated"] * capped
        assert not capped or "hold 3 Mev/s" in found[0].text


@given(st.lists(st.integers(0, 3_000), min_size=1, max_size=300), st.integers(1, 9))
def test_events_of_each_millisecond(steps: list[int], pieces: int) -> None:
    """Against NumPy's count of the milliseconds that are over."""
    t_us = np.cumsum(steps) * 7
    readout = ReadoutTally()
    for piece in np.array_split(t_us, pieces):
        readout.add(Events.of(piece, piece * 0, piece * 0, piece * 0))
    many = np.unique(t_us // 1000, return_counts=True)[1][:-1]
    share, most = readout.capped()
    assert most == pytest.approx(many.max(initial=0), rel=0.004)
    assert share == pytest.approx(
        (many == many.max()).mean() if len(many) else 0.0, abs=0 if most < 100 else 1
    )


def test_events_that_were_dropped() -> None:
    nothing = RunTally(LINK.packet)
    assert told(nothing, events=1_000_000, dropped_backward=90) == []
    (line,) = told(nothing, events=50_000, dropped_backward=90, dropped_off_sensor=20)
    assert line.startswith("110 events or words dropped (90 backward, 20 off sensor)")
    (doubt,) = find_warnings(Facts(LINK, nothing, {"events": 50_000}, lost=200))
    assert "200 in the file" in doubt.text


def test_bars_at_no_known_place_are_named_by_their_ids() -> None:
    for heard, says in (
        ({"0": 9, "1": 7, "2": 9}, "received: ids 7, 9: compare"),
        ({}, "received: no id: compare"),
    ):
        positions = dict(NO_POSITIONS, refused={"no-site": 4}, heard=heard)
        found = find_warnings(facts_of(positions))
        assert [says in str(one) for one in found if one.code == "no-site"] == [True]
        # A bar more beside those that are known is none.
        known = dict(positions, fixes=9)
        assert all(one.code != "no-site" for one in find_warnings(facts_of(known)))


@pytest.mark.parametrize(
    ("heard", "unseen", "says"),
    [
        ({"0": 7, "1": 107}, [8], "without id 107, received and in no site; id 8 of the sites was not"),
        ({"0": 7, "1": 9, "2": 4}, [1, 2], "without ids 4, 9, received and in no site; ids 1, 2 of the"),
        ({"0": 7, "1": 9}, list(range(20, 40)), "ids 20, 21, 22, 23, 24 and 15 more of the sites were not"),
        ({"0": 7, "1": 107}, [], None),
        ({"0": 7}, [8], None),
    ],
)
def test_a_bar_that_is_not_used_for_a_mistyped_id(
    heard: dict[str, int], unseen: list[int], says: str | None
) -> None:
    positions = dict(NO_POSITIONS, fixes=9, heard=heard, bars={"0": 7}, sites_unseen=unseen)
    doubts = find_warnings(facts_of(positions))
    found = [str(one) for one in doubts if one.code == "unknown-id"]
    assert [says in one for one in found] == [True] if says else not found


@pytest.mark.parametrize(("quality", "said"), [(0.75, False), (0.3, True)])
def test_symbols_that_are_wrong_by_the_receivers_own_account(quality: float, said: bool) -> None:
    tally = tally_of(RANDOM)
    tally.transmitters[0].quality_sum = quality * 60
    lines = told(tally)
    assert [
        line.startswith("transmitter 0: 70% of its frames have a symbol that is wrong") for line in lines
    ] == [True] * said


def test_what_is_not_found_is_looked_for_elsewhere() -> None:
    (note,) = find_notes(Facts(LINK, RunTally(LINK.packet), {"events": 9}))
    assert (note.code, note.next_step) == (
        "nothing-found",
        "`evlcp diagnose` says what blinks, and what to try",
    )
    assert find_notes(Facts(LINK, RunTally(LINK.packet), {"events": 0})) == []


def test_a_misfit_names_what_would_explain_it() -> None:
    for suspects, fits_mm, says in (
        ({"heading": 9, "bar 1": 2}, None, "another heading would explain it: compare --heading-deg"),
        (
            {"focal length": 10, "bar 0": 6},
            34.6,
            "another focal length or another bar 0 would explain it: compare camera.",
        ),
        ({"bar 0": 3}, None, "contradict one another: compare sites, angles and [camera], its focal_mm"),
        (
            {"bar 0": 10},
            51.2,
            "another focal length or another bar 0 would explain it: compare camera.focal_mm = 35: about 51.2"
            " would fit; place, angles and length of bar 0",
        ),
    ):
        positions = dict(NO_POSITIONS, refused={"misfit": 10}, suspects=suspects, focal_mm_fits=fits_mm)
        (doubt,) = [d for d in find_warnings(facts_of(positions)) if d.code == "misfit"]
        assert says in str(doubt)


def test_an_attitude_that_the_image_contradicts() -> None:
    (line,) = told(tally_of(RANDOM), frames=60, frames_askew=40)
    assert line.startswith("40 of 60 frames show bars that do not stand plumb")
    # One bar of three that is mounted so.
    assert told(tally_of(RANDOM), frames=60, frames_askew=20) == []


def test_a_reflection_is_not_doubted() -> None:
    assert told(tally_of(RANDOM % 16, ppm=5000, echo_of=3), blocks_tried=0) == []
    # In a wet road it stands on its head.
    head_down = 400 - LINK.camera.focal_px * LINK.bar.cluster_centres_m() / 50
    (line,) = told(tally_of(RANDOM, points=head_down))
    assert line.startswith("transmitter 0: its clusters stand the other way round")
    assert told(tally_of(RANDOM, points=head_down, echo_of=3)) == []
    tally = tally_of(RANDOM, points=head_down, echo_of=3)
    assert find_warnings(Facts(LINK, tally, {}, 0.0, 1e6, lit_us={0: (0.0, 9e5)})) == []


def test_what_blinks_without_a_preamble() -> None:
    nothing = RunTally(LINK.packet)
    (line,) = told(nothing, events_in_regions=5_000_000, regions_opened=1, locks=0)
    assert line.startswith("something blinks, 5000000 events in 1 region, but no preamble is detected")
    assert told(nothing, events_in_regions=5_000_000, regions_opened=2, locks=1) == []
    assert told(nothing, events_in_regions=20_000, regions_opened=3, locks=0) == []


def test_what_blinks_and_has_no_preamble_in_any_case() -> None:
    nothing = RunTally(LINK.packet)
    (line,) = told(nothing, events_in_regions=5_000_000, regions_opened=1, frames=0)
    assert line.startswith("something blinks, 5000000 events in 1 region, but no frame is read")
    assert told(nothing, events_in_regions=5_000_000, regions_opened=1, frames=2) == []


def test_a_light_that_is_the_other_way_round_than_said() -> None:
    (line,) = told(tally_of(RANDOM), frames=60, frames_inverted=50)
    assert line.startswith("50 of 60 frames fit only a light that is on where the link says off")
    assert told(tally_of(RANDOM), frames=60, frames_inverted=20) == []
    # Of a bar that another link reads.
    assert told(tally_of(RANDOM), frames=60, frames_inverted=90, frames_of_others=90) == []


def test_light_of_which_one_half_of_the_edges_is_not_seen() -> None:
    (line,) = told(tally_of(RANDOM), frames=60, events_in_regions=1000, events_in_regions_on=10)
    assert line.startswith("990 of 1000 events are OFF: when the light goes on is not seen")
    assert told(tally_of(RANDOM), frames=60, events_in_regions=1000, events_in_regions_on=100) == []


def test_frames_without_a_distance() -> None:
    (line,) = told(tally_of(RANDOM, distance=NONE))
    assert line.startswith("transmitter 0: 0 of 60 frames have a distance")
    # What there was no time for is no fault of the bar.
    assert told(tally_of(RANDOM, distance=NONE), frames_not_ranged=60) == []


def test_what_there_was_no_room_for_is_told() -> None:
    (line,) = told(tally_of(RANDOM), frames=60, dropped_crowded=7, frames_cut=3, steps_forgotten=50)
    assert "7 events of crowded time steps dropped; 3 frames passed over" in line
    assert told(tally_of(RANDOM), frames=60, steps_forgotten=50, areas_left_out=9) == []


@pytest.mark.parametrize(
    ("part", "what", "off", "sigma", "hint"),
    [
        ("camera", "focal_mm", 0.1, 0.02, "a focal length of 35.1 +- 0.02 mm, not 35"),
        ("camera", "focal_mm", 0.05, 0.02, None),
        ("camera", "focal_mm", 0.1, 0.199, None),
        ("bar 2", "east_m", 0.1, 0.02, None),
        ("bar 2", "east_m", -0.9, 0.02, "shows bar 2, east_m, -0.9 off what is stated, 0.2 (sigma): 4.5"),
    ],
)
def test_what_a_drive_tells_of_its_errors(
    part: str, what: str, off: float, sigma: float, hint: str | None
) -> None:
    row = {"part": part, "what": what, "correction": off, "sigma": sigma, "stated_sigma": 0.2}
    row["determined"] = sigma < 0.18
    positions = dict(NO_POSITIONS, fixes=1, learnt=[row])
    link = load_link(overrides=["camera_sigma.focal_mm=0.2"])
    found = [str(doubt) for doubt in find_warnings(facts_of(positions, link))]
    assert len(found) == (hint is not None)
    assert hint is None or hint in found[0]
