"""Where bars stand: the file and its faults, and the local axes against closed forms."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.scene.sites import BarSite, LocalAxes, load_sites, resolve_sites, site_of_transmitter

A_WGS84, F_WGS84 = 6_378_137.0, 1 / 298.257223563
BAR = {"transmitter_id": 1, "latitude_deg": 35.0, "longitude_deg": 137.0, "height_m": 5.0}


def ecef(latitude_deg: float, longitude_deg: float, height_m: float) -> np.ndarray:
    """The defining closed form of WGS-84."""
    phi, lam = math.radians(latitude_deg), math.radians(longitude_deg)
    e2 = F_WGS84 * (2 - F_WGS84)
    n = A_WGS84 / math.sqrt(1 - e2 * math.sin(phi) ** 2)
    out, up = (n + height_m) * math.cos(phi), (n * (1 - e2) + height_m) * math.sin(phi)
    return np.array([out * math.cos(lam), out * math.sin(lam), up])


def enu_axes(latitude_deg: float, longitude_deg: float) -> np.ndarray:
    """Rows: east, north, up."""
    turns = [longitude_deg + 90, 90 - latitude_deg]
    return Rotation.from_euler("ZX", turns, degrees=True).as_matrix().T


@given(
    st.floats(-89, 89), st.floats(-179, 179), st.floats(-100, 3000),
    st.floats(0, 359), st.floats(0, 180), st.floats(-0.01, 0.01), st.floats(-0.01, 0.01),
)  # fmt: skip
def test_clusters_stand_where_the_ellipsoid_says(lat, lon, height, heading, tilt, dlat, dlon) -> None:
    site = BarSite(1, lat, lon, height, heading, tilt, 1.6)
    axes = LocalAxes(lat + dlat, lon + dlon, height - 3)
    h, t = math.radians(heading), math.radians(tilt)
    axis = np.array([math.sin(t) * math.sin(h), math.sin(t) * math.cos(h), math.cos(t)])
    along = 1.6 * (np.array([0.375, 0.125, -0.125, -0.375]))
    world = ecef(lat, lon, height) + (along[:, None] * axis) @ enu_axes(lat, lon)
    want = (world - ecef(*axes.origin)) @ enu_axes(axes.latitude_deg, axes.longitude_deg).T
    np.testing.assert_allclose(site.cluster_positions_m(4, axes), want, atol=2e-8)


@given(st.floats(-85, 85), st.floats(-179, 179), st.floats(-1, 1), st.floats(-1, 1))
def test_vectors_turn_between_frames(lat: float, lon: float, dlat: float, dlon: float) -> None:
    one, two = LocalAxes(lat, lon, 10.0), LocalAxes(lat + dlat, lon + dlon, 40.0)
    want = enu_axes(one.latitude_deg, one.longitude_deg) @ enu_axes(two.latitude_deg, two.longitude_deg).T
    np.testing.assert_allclose(one.rotation_from(two), want, atol=1e-12)
    step = one.to_enu(*two.to_geodetic([3.0, -4.0, 5.0])) - one.to_enu(*two.to_geodetic([0.0, 0.0, 0.0]))
    np.testing.assert_allclose(one.rotation_from(two) @ [3.0, -4.0, 5.0], step, atol=1e-6)


def test_a_site_file(tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    path.write_text(
        "[[bar]]\ntransmitter_id = 7\nlatitude_deg = 35\nlongitude_deg = 137.0\nheight_m = 5.0\n"
        "tilt_deg = 3.0\nheading_deg = 90.0\ntransmitter = 1\n"
        "[[bar]]\ntransmitter_id = 9\nlatitude_deg = 35.0\nlongitude_deg = 137.0\nheight_m = 7.0\n"
    )
    first, second = load_sites(path)
    assert first == BarSite(7, 35.0, 137.0, 5.0, 90.0, 3.0, 0.96, 1)
    assert second == BarSite(9, 35.0, 137.0, 7.0)
    assert LocalAxes.of([first, second]).origin == (35.0, 137.0, 5.0)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({}, r"s: bar: expected one \[\[bar\]\] or more"),
        ({"bars": [BAR], "bar": [BAR]}, r"s: bars: unknown table; did you mean 'bar'\? \(known: bar\)"),
        ({"bar": [BAR, {**BAR, "transmitter_id": 2, "latitude_deg": 95.0}]},
         "s: bar.1.latitude_deg = 95.0: expected less than or equal to 90"),
        ({"bar": [{**BAR, "heading": 3}]},
         "s: bar.0.heading = 3: unknown key; did you mean 'heading_deg'"),
        ({"bar": [BAR, BAR]}, "s: bar.1.transmitter_id = 1: bar.0 has it, too; expected one each"),
        ({"bar": [{**BAR, "transmitter": 0}, {**BAR, "transmitter_id": 2, "transmitter": 0}]},
         "s: bar.1.transmitter = 0: bar.0 has it, too; expected one each"),
        ({"bar": [3]}, "s: bar.0 = 3: expected a table"),
    ],
)  # fmt: skip
def test_faults_name_their_place(table: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{message}"):
        resolve_sites(table, source="s")


def test_which_site_a_transmitter_stands_at() -> None:
    plain, numbered = BarSite(7, 35.0, 137.0, 5.0), BarSite(9, 35.0, 137.0, 5.0, transmitter=1)
    both = [plain, numbered]
    assert site_of_transmitter(both, 1) is numbered
    assert site_of_transmitter(both, 1, transmitter_id=7) is plain
    assert site_of_transmitter(both, 0, transmitter_id=8) is None
    assert site_of_transmitter(both, 0, is_only=True) is None
    assert site_of_transmitter([plain], 5, is_only=True) is plain
    assert site_of_transmitter([plain], 5) is None
    assert site_of_transmitter([numbered], 0, is_only=True) is None
    with pytest.raises(ConfigError, match="one bar or more"):
        LocalAxes.of([])
