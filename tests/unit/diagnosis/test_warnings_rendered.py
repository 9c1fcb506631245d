"""Warnings of recordings that the simulator renders: of each fault the one that is meant, of none none."""

from typing import Any

import pytest

from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.run import receive_to_folder
from evlcp_sdk.sim import load_scene
from evlcp_sdk.simulated import simulate

Keys = dict[str, Any]


def rendered(sent: tuple[str, ...], duration_s: float, changes: Keys) -> EventSource:
    light = {"background.light_w_m2": 0.01, "bars.0.led_w_m2": 8.0}
    scene = load_scene(
        "night", {"duration_s": duration_s, **light, **changes}, link=load_link(overrides=sent)
    )
    return simulate(scene, seed=3)


def warned(
    sent: tuple[str, ...] = (), read: tuple[str, ...] = (), duration_s: float = 0.12, **changes: Any
) -> list[Keys]:
    summary = receive_to_folder(rendered(sent, duration_s, changes), None, load_link(overrides=read))
    warnings: list[Keys] = summary["warnings"]
    return warnings


MESSAGES = {
    "bars.0.payload": "messages",
    "world.latitude_deg": 35.1,
    "world.longitude_deg": 137.0,
    "world.height_m": 50.0,
}


@pytest.mark.parametrize("changes", [{}, MESSAGES])
def test_nothing_is_wrong(changes: Keys) -> None:
    assert warned(duration_s=0.2, **changes) == []


def test_parts_of_a_near_bar_are_no_frames_of_another() -> None:
    """Pieces of a bar of 480 rows are followed before the whole of it is known."""
    near = {"motion.distance_m": 15.0, "motion.speed_mps": 0.0, "motion.vib_rate_rad_s": 0.0}
    day = {"background.light_w_m2": 1.0, "bars.0.led_w_m2": None, "sensor.hold": True, "sensor.refr_us": 20.0}
    summary = receive_to_folder(rendered((), 0.045, {**near, **day, "bars.0.x_m": -0.9}), None)
    counts = summary["counts"]
    assert counts["frames"] == 13
    assert (counts["frames_rejected"], counts["frames_of_parts"] >= 10) == (0, True)
    assert summary["warnings"] == []


@pytest.mark.parametrize(
    ("codes", "sent", "read", "says"),
    [
        ({"profile"}, ("modulation.id=wh8",), (), "was this sent with wh8? try --set modulation.id=wh8"),
        ({"unsure"}, (), ("modulation.id=wh8",), "was this sent with raw8 or wh4x2 (modulation.id)?"),
        ({"clock"}, ("air.chip_rate_hz=10012",), (), "air.chip_rate_hz = 100"),
        ({"frames-rejected", "coverage"}, (), ("air.chip_rate_hz=9900",), "air.frames_per_packet"),
        ({"frames-rejected"}, ("air.frames_per_packet=7",), (), "--link auto"),
    ],
)
def test_a_link_that_is_not_the_senders(
    codes: set[str], sent: tuple[str, ...], read: tuple[str, ...], says: str
) -> None:
    found = warned(sent, read, 0.2 if "coverage" in codes else 0.13)
    assert {one["code"] for one in found} == codes
    assert any(says in one["next_step"] for one in found)


def test_messages_that_cannot_be_read() -> None:
    """Another error correction than the sender's: its beacon comes again and again."""
    (one,) = warned(("error-correction.id=reed-solomon",), duration_s=0.2, **MESSAGES)
    assert one["code"] == "blocks-unread"
    assert "error-correction.id" in one["next_step"]


def test_a_bar_of_another_length() -> None:
    """The beacon says .96 m, the link 1.2: all distances are a quarter too long."""
    found = warned((), ("bar.led_pitch_m=0.0125",), **MESSAGES)
    assert [one["code"] for one in found] == ["bar-length"]
    assert "25% too long" in found[0]["text"]


def test_clusters_that_are_hidden() -> None:
    (one,) = warned(**{"bars.0.covered": [4, 5]})
    assert (one["code"], one["text"]) == ("clusters-hidden", "clusters never seen: 4, 5")
