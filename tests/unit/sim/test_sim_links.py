"""Bars with links: what is read and refused, where a panel shines, that every link is received."""

import math
import pickle
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import resolve
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.sim import (
    BarSpec,
    Scene,
    load_scene,
    resolve_scene,
    scene_of_truth,
    truth_of,
)
from evlcp_sdk.sim.light import BarLight
from evlcp_sdk.sim.scene import LensSpec, links_of
from tests.unit.sim.scenes import STILL, every, rows, still

PANEL = {"rows": 16, "columns": 16, "led_pitch_m": 0.02, "cluster_rows": 4, "cluster_columns": 4}


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
    assert resolve_scene(asdict(scene)) == scene
    assert links_of(scene_of_truth(truth_of(scene).to_table())) == links_of(scene)


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
    events = every(still(0.01, lens=LensSpec(wings=False), bars=(bar,)))
    x, y, z = (turned(bar, link.bar.led_positions_m())[link.bar.led_clusters() == cluster]).T
    u, v = (camera.focal_px * a / (z + 50.0) + c for a, c in zip((x, y), camera.centre_px, strict=True))
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

    def bar(name: str, aside_m: float, columns: int) -> BarSpec:
        link, file = {"bar": column | {"columns": columns}}, str(tmp_path / f"{name}.npy")
        return BarSpec(-1.5 + aside_m, link=link, chips_file=file, start_chip=3.0, ppm=20.0, led_w_m2=30.0)

    scene = Scene(duration_s=0.02, motion=STILL, bars=(bar("both", 0.0, 2),))
    apart = bar("left", -0.01, 1), bar("right", 0.01, 1)
    assert rows(every(scene)) == rows(every(replace(scene, bars=apart)))
