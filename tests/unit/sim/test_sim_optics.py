"""The lens against closed forms and brute force: the Airy pattern's wings, a strip's light on the pixels."""

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.special import j0, j1

from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.sim import BackgroundSpec, BarSpec, Scene, SensorSpec, Simulation, WiperSpec, _kernels
from evlcp_sdk.sim.motion import project
from evlcp_sdk.sim.optics import blur_of
from evlcp_sdk.sim.scene import LensSpec
from tests.unit.sim.scenes import STILL

Floats = NDArray[np.float64]

CAMERA = CameraModel()


def image_of_rectangle(
    lens: LensSpec, width_px: float, length_px: float, sigma_px: float, *, size: int = 2048, per_px: int = 8
) -> Floats:
    """Share of the pixels around a rectangle that it lights, by the transfer functions of all that blurs it.

    Returns:
        float64 (size, size): along and across from the middle, `per_px` samples a px.
    """
    nu = np.fft.fftfreq(size, 1 / per_px)
    along, across = nu[:, None], nu[None, :]
    radius = np.hypot(along, across) * lens.wavelength_nm * 1e-3 * lens.f_number / CAMERA.pitch_um
    x = np.minimum(radius, 1)
    aperture = 2 / math.pi * (np.arccos(x) - x * np.sqrt(1 - x**2))
    transfer = aperture * np.exp(-2 * (math.pi * sigma_px) ** 2 * (along**2 + across**2))
    transfer *= 1 - lens.halo - lens.bloom
    for share, halo_px in ((lens.halo, lens.halo_px), (lens.bloom, lens.bloom_px)):
        transfer += share * np.exp(-2 * (math.pi * halo_px) ** 2 * (along**2 + across**2))
    transfer = transfer * np.sinc(along) * np.sinc(across)
    rectangle = length_px * np.sinc(length_px * along) * width_px * np.sinc(width_px * across)
    return np.fft.fftshift(np.fft.ifft2(transfer * rectangle).real) * per_px**2


@pytest.mark.parametrize("f_number", [1.4, 2.0, 4.0])
def test_the_gaussians_throw_as_much_light_aside_as_the_airy_pattern(f_number: float) -> None:
    lens = LensSpec(blur_px=0.05, f_number=f_number)
    blur = blur_of(lens.focus_m, lens, CAMERA)
    assert blur.share.sum() == pytest.approx(1, abs=1e-12)
    assert (blur.share > 0).all()
    radius = np.linspace(0.4 * f_number, 10.0, 60)
    found = (blur.share * np.exp(-(radius[:, None] ** 2) / (2 * blur.sigma_px**2))).sum(1)
    # The rings are averaged out, as pixels and blur do: over one of them about each radius. What an ideal
    # lens throws further than a radius is J0(v)^2 + J1(v)^2.
    ring_px = lens.wavelength_nm * 1e-3 * f_number / CAMERA.pitch_um
    v = math.pi * (radius[:, None] / ring_px + np.linspace(-0.5, 0.5, 41))
    closed = (j0(v) ** 2 + j1(v) ** 2).mean(1)
    np.testing.assert_allclose(found, closed, rtol=0.07)
    np.testing.assert_allclose(found[radius < 4], closed[radius < 4], rtol=0.03)


def test_the_light_on_each_pixel_is_that_of_the_lens(tmp_path: Path) -> None:
    """A bar that stands still, dimmed by a wiper, beside the transfer functions of all that blurs it."""
    lit = np.array([1, 0, 0, 1, 1, 0, 0, 0, 1, 0, 1, 1, 0, 0, 0, 1])
    # A last chip of darkness, never sent in this time, says that the bar blinks.
    np.save(tmp_path / "chips.npy", [*[lit] * 99, 0 * lit])
    lens = LensSpec(bloom=0.3, bloom_px=6.0)
    scene = Scene(
        duration_s=0.004,
        lens=lens,
        motion=STILL,
        background=BackgroundSpec(light_w_m2=0.01, texture=0.0),
        sensor=SensorSpec(noise_hz=0.0, hot_share=0.0),
        bars=(BarSpec(chips_file=str(tmp_path / "chips.npy"), start_chip=10.0),),
        wiper=WiperSpec(share=0.8, at_s=0.0, lasts_s=0.008, edge_s=0.002),
    )
    simulation = Simulation(scene)
    for _ in simulation.stream():
        pass
    light = simulation._state[:, _kernels.LIGHT].reshape(CAMERA.height, CAMERA.width)
    place, _ = project(
        np.array([[-1.5, -0.48, 0.0], [-1.5, 0.48, 0.0]]), *simulation.path.sample([2000.0]), CAMERA
    )
    (x, top), (_, bottom) = place[0]
    cluster_px, width_px = (bottom - top) / 16, 0.005 / 50 * CAMERA.focal_px
    image = image_of_rectangle(lens, width_px, cluster_px, lens.blur_px)
    rows, columns = np.arange(round(top) - 8, round(bottom) + 9), np.arange(round(x) - 9, round(x) + 10)
    expected = np.full((len(rows), len(columns)), 0.01)
    for k in np.flatnonzero(lit):
        along = (rows - (top + (k + 0.5) * cluster_px)) * 8 + 1024
        place_ = np.meshgrid(along, (columns - x) * 8 + 1024, indexing="ij")
        # What is 128 px away and more is not in the image, and not to be seen.
        expected += simulation.bars[0].light_w_m2 * map_coordinates(image, place_, order=3)
    expected = 0.2 * expected + scene.sensor.dark_w_m2
    seen = light[rows][:, columns]
    active = seen > 0
    assert active.mean() > 0.9
    np.testing.assert_allclose(seen[active], expected[active], rtol=0.03, atol=5e-4)
    assert seen[active].sum() == pytest.approx(expected[active].sum(), rel=1e-3)
