"""Packets of characters with long pauses between, rendered pixel by pixel: what is dark says nothing."""

from pathlib import Path

import numpy as np
import pytest

import evlcp_sdk as evlcp
from evlcp_sdk.air.frames import packet_chips
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.rx.receiver import Receiver

TEXTS = "first", "second"


@pytest.mark.parametrize("idle", ["off", "on"])
def test_a_pause_has_no_characters(tmp_path: Path, idle: str) -> None:
    one_led = ["bar.rows=6", "bar.cluster_rows=6", "bar.columns=1", "bar.cluster_columns=1"]
    link = load_link(None, [*one_led, "framing.id=uart", "air.frames_per_packet=100", f"framing.idle={idle}"])
    rest = int(idle == "on")
    parts, sent = [], []
    for text, pause_ms in zip(TEXTS, (100, 200), strict=True):
        (packet,) = evlcp.compose(link, text=text, sequence=ord(text[0]))
        sent.append(packet[:, 0])
        pause = np.full((round(pause_ms * link.air.chip_rate_hz / 1e3), 1), rest, np.uint8)
        parts += [pause, packet_chips(packet, link.codebook)]
    chips = np.concatenate(parts)
    np.save(tmp_path / "chips.npy", chips)
    scene = {
        "name": "pauses",
        "duration_s": len(chips) / link.air.chip_rate_hz,
        "link": {table: dict(values) for table, values in link.table.items()},
        "camera": dict(link.table["camera"]),
        "lens": {"focus_m": 30.0},
        "motion": {"distance_m": 30.0, "speed_mps": 0.0, "vib_rate_rad_s": 0.0},
        "bars": [{"x_m": 0.0, "chips_file": str(tmp_path / "chips.npy")}],
    }
    receiver, packets = Receiver(link), []
    with evlcp.simulate(scene, seed=1) as source:
        for events in source.chunks():
            packets += receiver.feed(events)
        packets += receiver.close()
    assert {m.value for packet in packets for m in packet.messages} == set(TEXTS)
    # The chips come round and begin anywhere, so that one packet may be cut in two.
    heard = [int(f.soft.symbols[0]) for packet in packets for f in packet.frames]
    assert 2 * len(sent[0]) - 2 <= len(heard) <= 2 * len(sent[0])
