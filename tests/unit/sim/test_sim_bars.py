"""Bars: where LEDs of any layout shine, which link each sends with, and that messages are what they say."""

import json
import math
import pickle
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from evlcp_sdk.air.beacons import Beacon
from evlcp_sdk.air.blocks import Block, Kind
from evlcp_sdk.air.frames import bits_of_symbols
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import load_link, resolve
from evlcp_sdk.link.sections import AirSpec
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.scene.sites import BarSite, to_toml
from evlcp_sdk.sim import BarSpec, Truth, load_scene, resolve_scene, sites_of, truth_of
from evlcp_sdk.sim.light import BarLight, sources_of
from evlcp_sdk.sim.scene import LensSpec, links_of
from evlcp_sdk.simulated import simulate
from evlcp_sdk.study.measure import tally_messages
from evlcp_sdk.study.tally import Tally
from evlcp_sdk.values import Packet
from tests.unit.sim.scenes import every, still_scene

PANEL = {"rows": 16, "columns": 16, "led_pitch_m": 0.02, "cluster_rows": 4, "cluster_columns": 4}


def test_a_bar_lays_its_tables_over_the_scene_s(tmp_path: Path) -> None:
    (tmp_path / "other.toml").write_text('[modulation]\nid = "raw8"\n')
    (tmp_path / "common.toml").write_text("[air]\nchip_rate_hz = 8000.0\nframes_per_packet = 20\n")
    (tmp_path / "scene.toml").write_text(
        'link = "common.toml"\n[[bars]]\n[[bars]]\n[bars.link.air]\nchip_rate_hz = 5000.0\n'
        '[bars.link.modulation]\nid = "wh8"\n[[bars]]\nlink = "other.toml"\n'
    )
    scene = load_scene(tmp_path / "scene.toml", ["link.air.pilot_every=2", "bars.1.link.bar.rows=48"])
    # A file stands for itself.
    assert [(k.air, k.codebook.profile, len(k.bar.led_clusters())) for k in links_of(scene)] == [
        (AirSpec(8000.0, 20, 2), "wh4x2", 96),
        (AirSpec(5000.0, 20, 2), "wh8", 48),
        (AirSpec(10_000.0, 10, 1), "raw8", 96),
    ]
    for name in ("scene", "common", "other"):
        (tmp_path / f"{name}.toml").unlink()
    assert links_of(pickle.loads(pickle.dumps(scene))) == links_of(scene)
    assert resolve_scene(asdict(scene)) == scene
    assert links_of(resolve_scene(truth_of(scene).table["simulator"])) == links_of(scene)


def turn_points(bar: BarSpec, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (x right, y down, z towards the camera) in the scene, by matrices: tilted, then leaned."""
    tilt, lean = math.radians(bar.tilt_deg), math.radians(bar.lean_deg)
    back = np.array([[1, 0, 0], [0, math.cos(tilt), math.sin(tilt)], [0, -math.sin(tilt), math.cos(tilt)]])
    aside = np.array([[math.cos(lean), -math.sin(lean), 0], [math.sin(lean), math.cos(lean), 0], [0, 0, 1]])
    ahead = points_m * [1, 1, -1]
    return ahead @ back.T @ aside.T + [bar.x_m, bar.y_m, bar.z_m]


RING = {"shape": "ring", "leds": 12, "radius_m": 0.3}
LEDS = [[0, 0, 0.2, 0], [0.31, 0, 0, 2], [0.1, -0.2, 0.4, 1], [0.3, 0, 0, 1]]


@pytest.mark.parametrize(
    ("layout", "cluster"),
    [
        (RING, 0),
        (RING, 4),
        ({"shape": "columns", "apart_m": 0.4, "rows": 24, "cluster_rows": 6}, 6),
        ({"shape": "table", "leds": LEDS}, 0),
        ({"shape": "table"}, 0),
        (PANEL, 6),
    ],
)
def test_a_cluster_of_any_layout_blinks_where_a_pinhole_shows_it(layout, cluster, tmp_path) -> None:
    link = resolve({"bar": layout})
    chips = np.zeros((2, link.bar.clusters), np.uint8)
    chips[1, cluster] = 1
    np.save(tmp_path / "chips.npy", chips)
    bar = BarSpec(
        x_m=0.5, lean_deg=15.0, tilt_deg=20.0, link={"bar": layout}, chips_file=str(tmp_path / "chips.npy")
    )
    camera = CameraModel()
    events = every(still_scene(0.01, lens=LensSpec(wings=False), bars=(bar,)))
    x, y, z = (turn_points(bar, link.bar.led_positions_m())[link.bar.led_clusters() == cluster]).T
    u, v = (camera.focal_px * a / (z + 50.0) + c for a, c in zip((x, y), camera.centre_px, strict=True))
    pixels = np.unique(np.stack([events.x, events.y], 1), axis=0)
    assert pixels.mean(0) == pytest.approx([u.mean(), v.mean()], abs=0.4)


def test_leds_that_no_scene_can_hold_are_refused() -> None:
    leds = [[0.01 * i, 0.013 * i * i, 0.0, 0] for i in range(65)]
    with pytest.raises(ConfigError, match=r"bars\.0\.link: bar: its LEDs stand in more than 64 columns"):
        BarLight(BarSpec(), resolve({"bar": {"shape": "table", "leds": leds}}), LensSpec(), 0, "bars.0")


WORLD = {"latitude_deg": 35.1, "longitude_deg": 136.9, "height_m": 50.0, "heading_deg": 20.0}


def blocks_of(light: BarLight, packets: int) -> list[Block]:
    """What packets of a bar say."""
    coder, bits = light.link.block_coder(), light.link.codebook.bits_per_symbol
    sent = [bits_of_symbols(light.symbols(q), bits) for q in range(packets)]
    return [Block.unpack(coder.decode_block((4 - 8.0 * one).astype(np.float32)) or b"") for one in sent]


def test_random_data_is_a_message_a_packet() -> None:
    scene = resolve_scene({"bars": [{"payload": "data"}, {"payload": "data", "transmitter_id": 9}]})
    for light, transmitter_id in zip(sources_of(scene)[0], (1, 9), strict=True):
        blocks = blocks_of(light, 3)
        assert [(b.kind, b.transmitter_id, b.sequence, b.index) for b in blocks] == [
            (Kind.DATA, transmitter_id, q, 0) for q in range(3)
        ]
        assert len({b.part for b in blocks}) == 3
        assert {(len(b.part), b.length) for b in blocks} == {(40, 40)}


def test_a_bar_in_the_world_sends_its_beacon() -> None:
    scene = resolve_scene({"bars": [{"payload": "messages", "text": "Tempo 30"}], "world": WORLD})
    light = sources_of(scene)[0][0]
    assert (light.symbols(0) == light.symbols(2)).all()
    beacon, text = blocks_of(light, 2)
    assert (beacon.kind, beacon.transmitter_id) == (Kind.BEACON, 1)
    assert (text.kind, text.part) == (Kind.TEXT, b"Tempo 30")
    reported, (site,) = Beacon.unpack(beacon.part), sites_of(scene)
    assert reported.latitude_deg == pytest.approx(site.latitude_deg, abs=6e-10)
    assert reported.height_m == pytest.approx(site.height_m, abs=6e-4)
    assert (reported.heading_deg, reported.tilt_deg) == pytest.approx(
        (site.heading_deg, site.tilt_deg), abs=6e-3
    )


@pytest.mark.parametrize(
    ("bar", "message"),
    [
        ({"payload": "messages"}, r'bars.0: payload = "messages": expected a text, or a \[world\]'),
        ({"payload": "data", "link": {"air": {"frames_per_packet": 2}}}, "bars.0: .* expected at least"),
        ({"link": {"error-correction": {"id": "pole"}}}, "bars.0.link: .*did you mean 'polar'"),
        ({"payload": "data", "symbols": [[[0] * 16] * 10]}, "bars.0.payload = 'data': expected 'symbols'"),
        ({"text": "hi"}, "bars.0.payload = 'symbols': expected 'messages' beside text"),
    ],
)
def test_what_cannot_be_sent_is_reported(bar: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        sources_of(resolve_scene({"bars": [bar]}))


def test_a_campaign_counts_messages() -> None:
    scene = load_scene("drive-30kmh", {"duration_s": 0.15, "bars.payload": "data", "bars.start_chip": 300.0})
    receiver = Receiver(load_link())
    known, packets = truth_of(scene, 3), receiver.feed(every(scene, 3)) + receiver.close()
    coder = load_link().block_coder()

    def total(packets: list[Packet], known: Truth = known) -> tuple[int, int, int]:
        tally = Tally.sum(t for _, t in tally_messages(packets, known, coder))
        return tally.messages_sent, tally.messages_found, tally.messages_wrong

    # Packets begin 4.6, 39.2, 73.8, 108.4 and 143 ms after the scene: four are on air as a whole.
    assert total(packets) == (4, 4, 0)
    assert total([p for p in packets if p.packet != 2]) == (4, 3, 0)
    (bar,) = known.bars
    wrong = replace(known, bars=(replace(bar, symbols=bar.symbols ^ 1),))
    assert total(packets, wrong)[1:] == (0, sum(p.block is not None for p in packets))
    assert tally_messages([], replace(known, bars=(replace(bar, payload="symbols"),)), coder) == []


def test_from_a_scene_to_the_lines_of_a_result(evlcp: Any, tmp_path: Path) -> None:
    key, chips, rec, out = (tmp_path / n for n in ("k.pem", "chips.npy", "rec.raw", "out"))
    site = tmp_path / "site.toml"
    site.write_text(to_toml([BarSite(7, 35.1, 136.9, 52.4)]))
    pytest.importorskip("cryptography", reason="the extra sign is not installed")
    public = evlcp("tx", "keygen", key).out.strip()
    assert "a key is not overwritten" in evlcp("tx", "keygen", key).err
    assert evlcp("tx", "keygen", key, "--show").out.strip() == public
    message = f"--text Tempo_30 --beacon {site} --key {key} --sequence 5 --chips {chips}"
    assert evlcp("tx", "message", *message.split()).code == 0
    settings = {"duration_s": 0.2, "bars.start_chip": 1380.0, "bars.chips_file": str(chips)}
    simulate(load_scene("drive-30kmh", settings)).save(rec)
    reported = evlcp("receive", rec, "-o", out, "--set", f'messages.trusted_keys=[{{key="{public}"}}]')
    assert reported.code == 0, reported.err
    lines = [json.loads(line) for line in (out / "packets.jsonl").read_text().splitlines()]
    messages = [line for line in lines if line["kind"] != "packet"]
    assert sorted((m["kind"], m["trust"]) for m in messages) == [
        ("beacon", "unverified"),
        ("beacon", "verified"),
        ("text", "unverified"),
    ]
    (text,) = (m for m in messages if m["kind"] == "text")
    assert (text["text"], text["transmitter_id"], text["sequence"]) == ("Tempo_30", 7, 5)
    (beacon,) = (m for m in messages if m["verified"])
    assert (beacon["latitude_deg"], beacon["longitude_deg"], beacon["height_m"]) == (35.1, 136.9, 52.4)
    assert "2 messages; beacons once verified, once unverified; how old verified ones are" in reported.out
    assert beacon["reason"] == "signed 1970-01-01 00:00:05 UTC; when it was received is not known"
