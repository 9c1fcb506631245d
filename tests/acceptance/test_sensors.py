"""Sensors of other makers, as docs/sensors.md has them."""

import runpy
from pathlib import Path

import pytest

TABLE = runpy.run_path(str(Path(__file__).parents[2] / "docs" / "figures" / "sensors.py"))


@pytest.mark.parametrize("name", sorted(TABLE["SENSORS"]))
def test_a_sensor_reads_a_bar_whose_clusters_cover_four_pixels(name: str) -> None:
    tally = TABLE["drive"](name, 1)
    assert tally.frames_found == tally.frames_sent >= 14
    assert tally.bits > 1000
    assert tally.bit_errors == 0
    assert tally.rmse_m < 0.004 * TABLE["distance_m"](TABLE["load_link"](TABLE["LINKS"] / f"{name}.toml"))
