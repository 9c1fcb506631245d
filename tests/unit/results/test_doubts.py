"""What looks wrong is said, and nothing of what looks right."""

from dataclasses import replace

import numpy as np
import pytest

from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.results.doubts import warnings_of
from evlcp_sdk.results.tallies import RunTally
from evlcp_sdk.values import Frame, Packet, Range, SoftSymbols

LINK = load_link()
NONE = Range(float("nan"), float("nan"), 0)
NEAR = Range(50.0, 0.1, 15)


def tally_of(
    symbols: np.ndarray, *, ppm: float = 0.0, echo_of: int | None = None, distance: Range = NEAR
) -> RunTally:
    """Packets of ten frames with these symbols, (packets, 10, 16)."""
    tally = RunTally(LINK.packet)
    for n, packet in enumerate(symbols):
        frames = tuple(
            Frame(
                0, n, f, 0.0, SoftSymbols(said, np.zeros((16, 6), np.float32), 1.0), distance, None, 0.0, 0.0
            )
            for f, said in enumerate(packet)
        )
        frames = tuple(replace(frame, echo_of=echo_of) for frame in frames)
        period_us = LINK.packet.packet_chips * 100.0 / (1 + ppm * 1e-6)
        tally.add(Packet(0, n, n * period_us, 100.0, frames, 10))
    return tally


def told(tally: RunTally, link: Link = LINK, **counts: int) -> list[str]:
    return warnings_of(tally, counts, link)


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
    assert "modulation.id" in line


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
    (line,) = told(tally_of(RANDOM), frames=60, frames_unread=20)
    assert line.startswith("20 of 80 frames show their clusters, but not one symbol")
    # A truck before it is no fault of the link's.
    assert told(tally_of(RANDOM), frames=60, frames_dark=60, frames_rejected=6, frames_unread=6) == []
    (line,) = told(tally_of(RANDOM), blocks_tried=6)
    assert "error-correction.id" in line
    assert warnings_of(tally_of(RANDOM), {"blocks_tried": 6}, LINK, reads_messages=False) == []
    (line,) = told(tally_of(RANDOM), blocks_tried=6, blocks_decoded=4, blocks_other_codebook=2)
    assert line.startswith("2 packets were sent with another codebook")


def test_an_attitude_that_the_image_contradicts() -> None:
    (line,) = told(tally_of(RANDOM), frames=60, frames_askew=40)
    assert line.startswith("40 of 60 frames show bars that do not stand plumb")
    # One bar of three that is mounted so.
    assert told(tally_of(RANDOM), frames=60, frames_askew=20) == []


def test_a_reflection_is_not_doubted() -> None:
    assert told(tally_of(RANDOM % 16, ppm=5000, echo_of=3), blocks_tried=0) == []


def test_what_blinks_without_a_preamble() -> None:
    nothing = RunTally(LINK.packet)
    (line,) = told(nothing, events_in_regions=5_000_000, regions_opened=1)
    assert line.startswith("something blinks, 5000000 events in 1 regions, but no preamble is heard")
    assert told(nothing, events_in_regions=5_000_000, regions_opened=2, locks=1) == []
    assert told(nothing, events_in_regions=20_000, regions_opened=3) == []


def test_frames_without_a_distance() -> None:
    (line,) = told(tally_of(RANDOM, distance=NONE))
    assert line.startswith("transmitter 0: 0 of 60 frames have a distance")


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
    row["told"] = sigma < 0.18
    positions = {
        "fixes": 1,
        "refused": {},
        "gnss": 0,
        "gnss_without_heading": 0,
        "gnss_outside": 0,
        "bars_exact": [],
        "excluded": {},
        "alarms": {},
        "learnt": [row],
    }
    link = load_link(overrides=["camera_sigma.focal_mm=0.2"])
    found = warnings_of(RunTally(link.packet), {}, link, positions=positions)
    assert len(found) == (hint is not None)
    assert hint is None or hint in found[0]
