"""Layouts of LEDs, against what is written out by hand."""

import json
import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import load_link, resolve
from evlcp_sdk.link.text import to_toml
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.scene.bar import BarLayout, LedColumns, LedGrid, LedRing, LedTable
from evlcp_sdk.sim.scene import load_scene

TABLES: dict[str, dict[str, Any]] = {
    "grid": {"rows": 4, "columns": 2, "cluster_rows": 2},
    "columns": {"shape": "columns", "columns": 3, "rows": 4, "cluster_rows": 2, "apart_m": 0.3},
    "ring": {"shape": "ring", "leds": 8, "cluster_leds": 2, "radius_m": 0.1},
    "table": {"shape": "table", "leds": [[0.1, 0, 0, 1], [0, -0.2, 0.05, 0], [0.3, 0, 0, 1]]},
    "one": {"shape": "table"},
}


def test_columns_are_counted_down_the_first_and_then_the_next() -> None:
    bar = BarLayout(LedColumns(columns=2, rows=4, led_pitch_m=0.1, cluster_rows=2, apart_m=0.6))
    x, y, z = bar.led_positions_m().T
    assert_allclose(x, [-0.3] * 4 + [0.3] * 4)
    assert_allclose(y, [-0.15, -0.05, 0.05, 0.15] * 2)
    assert not z.any()
    assert bar.led_clusters().tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert (bar.clusters, bar.length_m, bar.width_m) == (4, pytest.approx(0.4), pytest.approx(0.7))


def test_a_ring_runs_clockwise_from_the_top() -> None:
    bar = BarLayout(LedRing(leds=4, radius_m=0.5, led_m=0.01))
    assert_allclose(bar.cluster_centres_m(), [[0, -0.5], [0.5, 0], [0, 0.5], [-0.5, 0]], atol=1e-9)
    assert bar.length_m == pytest.approx(1.01)


def test_clusters_of_a_table_have_any_size() -> None:
    bar = BarLayout(LedTable(((0.1, 0, 0, 1), (0, -0.2, 0.05, 0), (0.3, 0, 0.1, 1))))
    assert_allclose(bar.cluster_positions_m(), [[0, -0.2, 0.05], [0.2, 0, 0.05]])
    assert_allclose(bar.cluster_centres_m(), [[0, -0.2], [0.2, 0]])
    assert bar.led_clusters().tolist() == [1, 0, 1]


def test_an_even_column_is_known_however_it_is_described() -> None:
    column = tuple((0.0, 0.06 * (i // 6) + 0.01 * (i % 6), 0.0, i // 6) for i in range(24))
    for leds in (LedGrid(), LedColumns(columns=1), LedTable(column)):
        assert BarLayout(leds).column_pitch_m == pytest.approx(0.06)
    for other in (
        *(LedColumns(), LedRing(), LedGrid(rows=1, columns=6, cluster_rows=1), LedGrid(rows=6)),
        LedTable(((0, 0, 0, 0), (0, 1, 0, 1), (0, 3, 0, 2))),
        LedTable(((0, 0, 0, 2), (0, 1, 0, 1), (0, 2, 0, 0))),
        LedTable(((0, 0, 0, 0), (0, 1, 0.1, 1), (0, 2, 0, 2))),
    ):
        assert math.isnan(BarLayout(other).column_pitch_m)


@pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)
def test_a_link_s_table_comes_back(table: dict[str, Any], tmp_path: Path) -> None:
    link = resolve({"bar": table})
    assert resolve(json.loads(json.dumps(link.table))) == link
    assert BarLayout.of_table(link.table["bar"]) == link.bar == pickle.loads(pickle.dumps(link.bar))
    path = tmp_path / "link.toml"
    path.write_text(to_toml(link, Registry.load()))
    assert load_link(path).digest == link.digest
    assert link.codebook.clusters == link.bar.clusters
    assert "shape" not in link.table["bar"] or link.table["bar"]["shape"] == table["shape"]


def test_sides_say_where_light_goes_on() -> None:
    # 1 above, 2 below, 4 left, 8 right.
    assert BarLayout().lit_sides.tolist() == [2, *[3] * 14, 1]
    panel = BarLayout(LedGrid(6, 6, 0.02, 2, 2)).lit_sides.reshape(3, 3)
    assert panel.tolist() == [[10, 14, 6], [11, 15, 7], [9, 13, 5]]
    # Clusters six times as high as wide touch above and beside.
    assert BarLayout(LedGrid(12, 2, 0.01, 6)).lit_sides.tolist() == [10, 6, 9, 5]
    # Columns half a metre apart do not; nor do LEDs of a ring, nor lamps with gaps of two LEDs.
    assert BarLayout(LedColumns(2, 0.5, 18)).lit_sides.tolist() == [2, 3, 1] * 2
    assert not BarLayout(LedRing(12, 0.1)).lit_sides.any()
    for gap_m, sides in ((0.005, [2, 3, 1]), (0.02, [0, 0, 0])):
        lamps = [[0.0, 0.01 * i + gap_m * (i // 3), 0.0, i // 3] for i in range(9)]
        assert BarLayout.of_table({"shape": "table", "leds": lamps}).lit_sides.tolist() == sides


def test_even_columns_are_found_in_any_order() -> None:
    assert [(ids.tolist(), m) for ids, m in BarLayout().even_columns] == [(list(range(16)), 0.06)]
    # Two columns upside down beside a lone LED, and one whose steps are not even.
    places = [(0, 2), (1, 4), (0, 1), (1, 2), (0, 0), (1, 0), (2, 0)]
    leds = [[x, y, 0.0, k] for k, (x, y) in enumerate(places)]
    layout = BarLayout.of_table({"shape": "table", "leds": leds})
    assert [(ids.tolist(), m) for ids, m in layout.even_columns] == [([4, 2, 0], 1.0), ([5, 3, 1], 2.0)]
    leds[0][1] = 2.5
    layout = BarLayout.of_table({"shape": "table", "leds": leds})
    assert [ids.tolist() for ids, _ in layout.even_columns] == [[5, 3, 1]]
    assert BarLayout(LedRing()).even_columns == ()
    assert BarLayout(LedGrid(6, 4, cluster_rows=3)).even_columns == ()


def test_a_csv_file_is_read_into_the_table(tmp_path: Path) -> None:
    (tmp_path / "leds.csv").write_text("cluster,x_m,y_m,z_m\n1,0.1,0,0\n0,0,-0.2,0.05\n1,0.3,0,0\n")
    (tmp_path / "flat.csv").write_text("x_m,y_m,cluster\n0.1,0,0\n")
    (tmp_path / "link.toml").write_text('[bar]\nleds_file = "leds.csv"\n')
    link = load_link(tmp_path / "link.toml")
    assert link == resolve({"bar": TABLES["table"]})
    flat = load_link(tmp_path / "link.toml", [f"bar.leds_file={tmp_path / 'flat.csv'}"])
    assert flat.table["bar"]["leds"] == [[0.1, 0.0, 0.0, 0]]
    (tmp_path / "scene.toml").write_text(
        '[link.bar]\nleds_file = "leds.csv"\n[[bars]]\n[[bars]]\nlink = "link.toml"\n'
    )
    scene = load_scene(tmp_path / "scene.toml")
    (tmp_path / "leds.csv").unlink()
    assert [resolve(bar.link).bar for bar in scene.bars if isinstance(bar.link, dict)] == [link.bar] * 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x_m,y_m\n0,0\n", "line 1: no column cluster (columns: x_m, y_m, cluster, z_m)"),
        ("x_m,y_m,cluster\n0,101,0\n", "line 2: y_m = '101': expected -100 to 100"),
        ("x_m,y_m,cluster\n0,0,0.5\n", "line 2: cluster = 0.5: expected a whole number"),
        ("x_m,y_m,cluster\n0,0,-1\n", "line 2: cluster = '-1': expected 0 to 65535"),
    ],
)
def test_a_fault_of_a_csv_file_is_one_line(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "leds.csv").write_text(text)
    (tmp_path / "link.toml").write_text('[bar]\nleds_file = "leds.csv"\n')
    with pytest.raises(ConfigError) as fault:
        load_link(tmp_path / "link.toml")
    assert str(fault.value) == f"{tmp_path / 'link.toml'}: bar.leds_file: {tmp_path / 'leds.csv'}: {message}"


LEDS_BEHIND = [[0, 0, 0, 0], [0.1, 0, 0, 1], [0, 0, 0.3, 2]]


@pytest.mark.parametrize(
    ("bar", "message"),
    [
        ({"leds_file": 3}, "link.toml: bar.leds_file = 3: expected the name of a CSV file"),
        ({"leds_file": "a.csv", "leds": []}, 'link.toml: bar.leds_file = "a.csv": expected it'),
        ({"shape": "ring", "rows": 3}, "link.toml: bar.rows = 3: unknown key"),
        ({"shape": "ring", "cluster_leds": 5}, "bar.cluster_leds = 5: expected a divisor of bar.leds = 12"),
        ({"shape": [3]}, "link.toml: bar.shape = [3]: unknown shape (known: grid, columns, ring, table)"),
        ({"shape": "table", "leds": []}, "bar.leds: 0 LEDs: expected at most 65536 LEDs, and one at least"),
        ({"shape": "table", "leds": [[0, 0, 0, 1]]}, "bar.leds: no LED of cluster 0: expected clusters 0"),
        ({"shape": "table", "leds": LEDS_BEHIND}, "bar.leds: cluster 2 is behind cluster 0, LED by LED: exp"),
        ({"shape": "table", "leds": [[0, 0, 0, 0], [1e-8, 0, 0, 1]]}, "bar.leds.1: stands where bar.leds.0"),
    ],
)
def test_a_fault_of_a_layout_is_one_line(bar: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as fault:
        resolve({"bar": bar}, source="link.toml")
    (line,) = str(fault.value).splitlines()
    assert message in line


def test_too_many_leds_are_refused() -> None:
    leds = tuple((1e-4 * i, 0.0, 0.0, 0) for i in range(65537))
    with pytest.raises(ConfigError, match="65537 LEDs: expected at most 65536"):
        LedTable(leds)
    assert np.ptp(BarLayout(LedTable(leds[:-1])).led_positions_m()[:, 0]) == pytest.approx(6.5535)
