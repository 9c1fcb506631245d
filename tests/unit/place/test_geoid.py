"""Heights of the geoid, beside those that the model's makers publish to test programs with."""

import pytest
from hypothesis import given, strategies as st

from evlcp_sdk.place.gnss import geoid_m

# The points and heights that come with EGM96's own program, by interpolation in its grid of a quarter degree.
PUBLISHED = [
    (38.6281550, 269.7791550, -31.628),
    (-14.6212170, 305.0211140, -2.969),
    (46.8743190, 102.4487290, -43.575),
    (-23.6174460, 133.8747120, 15.871),
    (38.6254730, 359.9995000, 50.066),
    (-0.4667440, 0.0023000, 17.329),
]


@pytest.mark.parametrize(("latitude", "longitude", "height_m"), PUBLISHED)
def test_published_points(latitude: float, longitude: float, height_m: float) -> None:
    assert geoid_m(latitude, longitude) == pytest.approx(height_m, abs=0.5)


def test_poles() -> None:
    assert {geoid_m(90.0, lon) for lon in (-180, 0.5, 77, 359.9)} == {13.6}
    assert {geoid_m(-90.0, lon) for lon in (-180, 0.5, 77, 359.9)} == {-29.5}


@given(st.floats(-89.99, 89.99), st.floats(-180, 540))
def test_goes_around_without_a_seam(latitude: float, longitude: float) -> None:
    here = geoid_m(latitude, longitude)
    assert -107.1 <= here <= 85.5
    assert geoid_m(latitude, longitude + 1e-6) == pytest.approx(here, abs=0.1001)
    assert geoid_m(latitude, longitude - 360) == pytest.approx(here, abs=0.1001)
