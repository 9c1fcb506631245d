"""Bars with links: what is read and refused, where a panel shines, that every link is received."""

import math
import pickle
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from evlcp_sdk.air.codebook import chips_of_values, hadamard
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import Link, resolve
from evlcp_sdk.plugin.hooks import Algorithm, hookimpl
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.roles import Modulation
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.sim import (
    BarSpec,
    MotionSpec,
    Scene,
    SensorSpec,
    Simulation,
    load_scene,
    resolve_scene,
    scene_of_truth,
    scene_table,
    truth_of,
)
from evlcp_sdk.sim.light import BarLight
from evlcp_sdk.sim.scene import LensSpec, links_of
from evlcp_sdk.values import Events

PANEL = {"rows": 16, "columns": 16, "led_pitch_m": 0.02, "cluster_rows": 4, "cluster_columns": 4}
QUIET = SensorSpec(noise_hz=0.0, hot_share=0.0, noise_ln=0.0, p_on_miss=0.0, p_off_miss=0.0, th_spread=0.0)
STILL = MotionSpec(distance_m=30.0, speed_mps=0.0, vib_rate_rad_s=0.0)


@dataclass(frozen=True)
class Four(Modulation):
    """Two bits a symbol: a modulation of somebody else's."""

    def codewords(self) -> NDArray[np.uint8]:
        return chips_of_values(np.repeat(hadamard(4), 2, axis=1))


class Stranger:
    """A package with a modulation."""

    @hookimpl
    def evlcp_algorithms(self) -> list[Algorithm]:
        return [Algorithm("modulation", "four", f"{__name__}:Four", 3, "two bits")]


def every(scene: Scene, seed: int = 1, registry: Registry | None = None) -> Events:
    return Events.concat(Simulation(scene, seed, registry=registry).stream())


def test_a_bar_lays_its_tables_over_the_scene_s(tmp_path: Path) -> None:
    (tmp_path / "other.toml").write_text('[modulation]\nid = "raw8"\n')
    (tmp_path / "common.toml").write_text("[air]\nchip_rate_hz = 8000.0\nframes_per_packet = 20\n")
    (tmp_path / "scene.toml").write_text(
        'link = "common.toml"\n[[bars]]\n[[bars]]\n[bars.link.air]\nchip_rate_hz = 5000.0\n'
        '[bars.link.modulation]\nid = "wh8"\n[[bars]]\nlink = "other.toml"\n'
    )
    scene = load_scene(tmp_path / "scene.toml", ["link.air.pilot_every=2", "bars.1.link.bar.rows=48"])
    found = [
        (
            k.air.chip_rate_hz,
            k.air.frames_per_packet,
            k.air.pilot_every,
            k.codebook.profile,
            len(k.bar.led_clusters()),
        )
        for k in links_of(scene)
    ]
    assert found == [
        (8000.0, 20, 2, "wh4x2", 96),
        (5000.0, 20, 2, "wh8", 48),
        (10_000.0, 10, 1, "raw8", 96),  # a file stands for itself
    ]
    for name in ("scene", "common", "other"):
        (tmp_path / f"{name}.toml").unlink()
    assert links_of(pickle.loads(pickle.dumps(scene))) == links_of(scene)
    assert resolve_scene(scene_table(scene)) == scene
    assert links_of(scene_of_truth(truth_of(scene).to_table())) == links_of(scene)


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ({"link": 3}, "s.toml: link = 3: expected a link.toml, or tables as in one"),
        ({"link": {"air": 3}}, "s.toml: link: air = 3: expected a table"),
        ({"link": {"air": {"chip_rate": 1.0}}}, "s.toml: link: air.chip_rate = 1.0: unknown key; did you"),
        ({"bars": [{"link": "no.toml"}]}, "s.toml: bars.0.link: no.toml: cannot be read"),
        (
            {"bars": [{}, {"link": {"modulation": {"id": "wh9"}}}]},
            "s.toml: bars.1.link: no modulation algorithm named 'wh9'",
        ),
        (
            {"bars": [{"link": {"bar": {"rows": 7}}}]},
            "s.toml: bars.0.link: bar.cluster_rows = 6: expected",
        ),
        (
            {"bars": [{"profile": "wh8"}]},
            'bars.0.profile = "wh8": unknown key; its link says it: bars.link.m',
        ),
        ({"bars": [{"chip_rate_hz": 5e3}]}, "unknown key; its link says it: bars.link.air.chip_rate_hz"),
        ({"bars": [{"length_m": 2.0}]}, "unknown key; its link says it: bars.link.bar.rows, bar.led_pitch_m"),
    ],
)
def test_faults_of_links_are_told_with_their_path(table: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError) as fault:
        resolve_scene(table, source="s.toml")
    assert says in str(fault.value)
    assert len(str(fault.value).splitlines()) == 1


def turned(bar: BarSpec, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (x right, y down, z towards the camera) in the scene, by matrices: tilted, then leaned."""
    tilt, lean = math.radians(bar.tilt_deg), math.radians(bar.lean_deg)
    back = np.array([[1, 0, 0], [0, math.cos(tilt), math.sin(tilt)], [0, -math.sin(tilt), math.cos(tilt)]])
    aside = np.array([[math.cos(lean), -math.sin(lean), 0], [math.sin(lean), math.cos(lean), 0], [0, 0, 1]])
    ahead = points_m * [1, 1, -1]
    found: NDArray[np.float64] = ahead @ back.T @ aside.T + [bar.x_m, bar.y_m, bar.z_m]
    return found


LAYOUTS: dict[str, dict[str, Any]] = {
    "ring": {"shape": "ring", "leds": 12, "radius_m": 0.3},
    "apart": {"shape": "columns", "apart_m": 0.4, "rows": 24, "cluster_rows": 6},
    "table": {
        "shape": "table",
        "leds": [[0, 0, 0.2, 0], [0.31, 0, 0, 2], [0.1, -0.2, 0.4, 1], [0.3, 0, 0, 1]],
    },
    "one": {"shape": "table"},
}


@pytest.mark.parametrize(
    ("layout", "cluster"),
    [
        (LAYOUTS["ring"], 0),
        (LAYOUTS["ring"], 4),
        (LAYOUTS["apart"], 6),
        (LAYOUTS["table"], 0),
        (LAYOUTS["one"], 0),
        (PANEL, 6),
    ],
)
def test_a_cluster_of_any_layout_blinks_where_a_pinhole_shows_it(
    layout: dict[str, Any], cluster: int, tmp_path: Path
) -> None:
    link = resolve({"bar": layout})
    chips = np.zeros((2, link.bar.clusters), np.uint8)
    chips[1, cluster] = 1
    np.save(tmp_path / "chips.npy", chips)
    bar = BarSpec(
        x_m=0.5, lean_deg=15.0, tilt_deg=20.0, link={"bar": layout}, chips_file=str(tmp_path / "chips.npy")
    )
    camera = CameraModel()
    scene = Scene(
        duration_s=0.01, camera=camera, lens=LensSpec(wings=False), sensor=QUIET, motion=STILL, bars=(bar,)
    )
    events = every(scene)
    x, y, z = (turned(bar, link.bar.led_positions_m())[link.bar.led_clusters() == cluster]).T
    u, v = (camera.focal_px * a / (z + 30.0) + c for a, c in zip((x, y), camera.centre_px, strict=True))
    pixels = np.unique(np.stack([events.x, events.y], 1), axis=0)
    assert pixels.mean(0) == pytest.approx([u.mean(), v.mean()], abs=0.4)


def test_leds_that_no_scene_can_hold_are_refused() -> None:
    leds = [[0.01 * i, 0.013 * i * i, 0.0, 0] for i in range(65)]
    with pytest.raises(ConfigError, match=r"bars\.0\.link: bar: its LEDs stand in more than 64 columns"):
        BarLight(BarSpec(), resolve({"bar": {"shape": "table", "leds": leds}}), LensSpec(), 0, "bars.0")


def test_two_columns_are_two_bars_side_by_side(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    chips = rng.integers(0, 2, (60, 16)).astype(np.uint8)
    for name, part in (("both", chips), ("left", chips[:, ::2]), ("right", chips[:, 1::2])):
        np.save(tmp_path / f"{name}.npy", part)
    column = {"rows": 48, "led_pitch_m": 0.02}
    common: dict[str, Any] = {"start_chip": 3.0, "ppm": 20.0}
    both = BarSpec(
        **common, link={"bar": column | {"columns": 2}}, chips_file=str(tmp_path / "both.npy"), led_w_m2=30.0
    )
    apart = [
        BarSpec(
            **common,
            x_m=-1.5 + aside,
            link={"bar": column},
            chips_file=str(tmp_path / f"{name}.npy"),
            led_w_m2=30.0,
        )
        for name, aside in (("left", -0.01), ("right", 0.01))
    ]
    scene = Scene(duration_s=0.02, motion=STILL, bars=(both,))
    one, two = every(scene), every(replace(scene, bars=tuple(apart)))
    assert all((getattr(one, name) == getattr(two, name)).all() for name in ("t_us", "x", "y", "p"))


LINKS: dict[str, dict[str, Any]] = {
    "5 kchip/s": {"air": {"chip_rate_hz": 5000.0}},
    "8 kchip/s": {"air": {"chip_rate_hz": 8000.0}},
    "4 clusters": {"bar": {"cluster_rows": 24}, "ranging": {"id": "joint-scale"}},
    "8 clusters": {"bar": {"cluster_rows": 12}},
    "32 clusters": {"bar": {"cluster_rows": 3}},
    "panel": {"bar": PANEL},
    "two columns": {"bar": {"rows": 24, "columns": 2, "led_pitch_m": 0.04, "cluster_rows": 3}},
    "barker13": {"pilots": {"id": "barker13"}},
    "a stranger's modulation": {"modulation": {"id": "four"}},
}


@pytest.mark.parametrize("name", LINKS)
def test_every_link_is_received(name: str) -> None:
    registry = Registry.load(Stranger())
    table = {"duration_s": 0.12, "motion": {"distance_m": 32.0}, "link": LINKS[name]}
    scene = resolve_scene(table, registry)
    link: Link = resolve(LINKS[name], registry)
    receiver = Receiver(link)
    simulation = Simulation(scene, 2, registry=registry)
    packets = [p for events in simulation.stream() for p in receiver.feed(events)] + receiver.close()
    (bar,) = truth_of(simulation, registry=registry).bars
    assert bar.link == link
    form, chip_us = bar.packet, 1e6 / bar.rate_hz
    heard = {
        round((frame.t_us / chip_us + bar.start_chip) * 2) / 2: frame for p in packets for frame in p.frames
    }
    wrong = erased = missed = sent = 0
    for q, packet in enumerate(bar.symbols):
        for f, symbols in enumerate(packet):
            start = q * form.packet_chips + form.frame_start_chip(f)
            end = q * form.packet_chips + form.frame_start_chip(f + 1)
            if (
                q * form.packet_chips < bar.start_chip
                or (end - bar.start_chip) * chip_us + 1000 > scene.duration_s * 1e6
            ):
                continue
            sent += 1
            near = [frame for chip, frame in heard.items() if abs(chip - start) <= 2]
            missed += not near
            for frame in near:
                given = frame.soft.symbols >= 0
                wrong += int((frame.soft.symbols != symbols)[given].sum())
                erased += int((~given).sum())
    assert sent >= 10
    assert (missed, wrong) == (0, 0)
    # Of a bar in parts, a cluster may be out of sight until all of it is known.
    assert erased <= 0.005 * sent * link.bar.clusters
