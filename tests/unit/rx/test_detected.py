"""Regions that a detection gives: the events from before it did."""

from dataclasses import dataclass

import numpy as np
import pytest

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.plugin.roles import Detection, Detector
from evlcp_sdk.rx.detected import DetectedRegions
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.values import Events, Region

GIVEN_AT = 100


@dataclass(frozen=True)
class Late(Detection):
    """Gives one region, from a step on."""

    def compile(self, camera: CameraModel, codebook: Codebook, packet: PacketFormat) -> Detector:
        return self

    def init(self) -> int:
        return 0

    def step(self, state: int, start_us: int, events: Events) -> tuple[int, list[Region]]:
        shown = [Region(0, start_us, 10.0, 10.0, 8.0, 8.0)] if state >= GIVEN_AT else []
        return state + 1, shown


@pytest.mark.parametrize(
    ("rate_hz", "kept_us"),
    # Twelve steps of 1.5 ms; two characters of ten bits of 2 ms, in whole steps.
    [(10_000.0, 18_000), (500.0, 40_500)],
)
def test_events_from_before_are_kept_for_two_frames(rate_hz: float, kept_us: int) -> None:
    link = load_link(
        overrides=[
            "framing.id=uart",
            "bar.rows=1",
            "bar.columns=1",
            "bar.cluster_rows=1",
            "bar.cluster_columns=1",
            "air.frames_per_packet=10",
            f"air.chip_rate_hz={rate_hz}",
        ]
    )
    regions = DetectedRegions(link.with_algorithm("detection", Late()))
    step_us = link.regions.step_us
    for start_us in range(0, (GIVEN_AT + 1) * step_us, step_us):
        one = np.array([start_us]), *(np.array([10], np.uint16) for _ in range(2)), np.array([1], np.uint8)
        found = regions.step(start_us, Events.of(*one))
    (followed,) = found
    assert GIVEN_AT * step_us - followed.first_us == kept_us
    assert [begun for begun, _ in followed.pieces] == list(
        range(GIVEN_AT * step_us - kept_us, (GIVEN_AT + 1) * step_us, step_us)
    )
    assert sum(len(events) for _, events in followed.pieces) == kept_us // step_us + 1
