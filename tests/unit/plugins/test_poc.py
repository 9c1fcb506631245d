"""Ranging by phase-only correlation: peaks by brute force, exact shifts, ideal images."""

import numpy as np
import pytest
from evlcp_centroid.ranging import CentroidRanging
from evlcp_poc import _kernels
from evlcp_poc.correlation import blob_band, full_band, measure_shifts, phase_only_correlation
from evlcp_poc.ranging import PocRanging
from numpy.testing import assert_allclose
from scipy.stats import norm

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.scene.bar import BarLayout, LedGrid, LedTable
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.values import FrameView, PresenceMap, SoftSymbols


def dirichlet(shift, size, band):
    """The kernel as the sum of cosines that it is."""
    k = np.arange(-(band // 2), band // 2 + 1)
    return np.cos(2 * np.pi * np.outer(shift, k) / size).sum(1) / size


def peak_shift(samples, size, band):
    """Least squares over shift and gain by brute force: a fine grid, then a finer one."""
    at = np.arange(len(samples)) - len(samples) // 2

    def rest(shift):
        m = dirichlet(at - shift, size, band)
        return ((samples - m * max(m @ samples / (m @ m), 0)) ** 2).sum()

    best, width = 0.0, 1.0
    for _ in range(5):
        grid = best + np.linspace(-width, width, 81)
        best, width = min(grid, key=rest), width / 20
    return best


def band_limited(rng, height, width):
    """A random image without its Nyquist frequencies, which no shift keeps real, and its spectrum."""
    spectrum = np.fft.rfft2(rng.normal(size=(height, width)))
    spectrum[height // 2] *= height % 2
    spectrum[:, -1] *= width % 2
    return spectrum


def shift_spectrum(spectrum, shape, down, right):
    v = np.fft.fftfreq(shape[0])[:, None]
    u = np.fft.rfftfreq(shape[1])
    return np.fft.irfft2(spectrum * np.exp(-2j * np.pi * (down * v + right * u)), shape).astype(np.float32)


def twin_correlation(one, other, down, across):
    """Of the phases of whole spectra, in double precision."""
    spectra = np.fft.rfft2(one.astype(float)).conj() * np.fft.rfft2(other.astype(float))
    spectra[:, down + 1 : one.shape[1] - down] = spectra[:, :, across + 1 :] = 0
    size = np.abs(spectra)
    return np.fft.irfft2(np.divide(spectra, size, out=0 * spectra, where=size > 0), one.shape[1:])


def jackknife(values, weights, first, second, kept):
    """Sigma of a weighted mean of pairs by leaving out one cluster after another."""
    means = []
    for k in np.union1d(first[kept], second[kept]):
        rest = kept[(first[kept] != k) & (second[kept] != k)]
        means.append(np.average(values[rest], weights=weights[rest]))
    return np.sqrt((len(means) - 1) * np.var(means))


def gaussian(centre, sigma, size):
    """A Gaussian's integral over each pixel of a line; pixel n reaches from n - 1/2 to n + 1/2."""
    return np.diff(norm.cdf(np.arange(size + 1) - 0.5, centre, sigma))


def box(centre, width, size):
    """The part of each pixel of a line that a box covers."""
    return np.diff(np.clip(np.arange(size + 1) - 0.5, centre - width / 2, centre + width / 2))


CAMERA, BAR = CameraModel(), BarLayout()
PANEL = BarLayout(LedGrid(rows=16, columns=16, cluster_rows=4, cluster_columns=4))
LINK = load_link()
SHAPES = [(24, 20), (25, 21), (16, 17), (48, 40)]


def fit_peak(samples, size, band):
    """By samples of a row about no shift, and the same of a column."""
    half = len(samples) // 2
    correlation, shifts = np.zeros((len(samples), 2, len(samples)), np.float32), np.empty((2, 2))
    correlation[half, 0] = samples
    correlation[:, 1, half] = samples
    _kernels.fit_peaks(correlation, (size, size), (band // 2, band // 2), half, shifts)
    assert shifts[0, 1] == shifts[1, 0]
    return shifts[0, 1]


@pytest.mark.parametrize("seed", range(10))
def test_a_noisy_peak_is_fitted_by_least_squares(seed):
    rng = np.random.default_rng(seed)
    size, samples = int(rng.integers(12, 50)), int(rng.integers(1, 5))
    band = size - 1 + size % 2
    kernel = dirichlet(np.arange(-samples, samples + 1) - rng.uniform(-0.6, 0.6), size, band)
    noisy = kernel + rng.normal(0, 0.05, len(kernel))
    # Steps end below 1e-3 px, the next would be quadratically smaller.
    assert fit_peak(noisy, size, band) == pytest.approx(peak_shift(noisy, size, band), abs=1e-4)


@pytest.mark.parametrize("samples", [[0, 0, 0], [-1, -2, -1], [0, 1, 0]])
def test_no_peak_is_no_shift(samples):
    assert fit_peak(samples, 24, 23) == 0


@pytest.mark.parametrize("most", [None, (3, 4), (1, 2)])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("samples", [1, 2, 4])
def test_exact_shifts_are_recovered(samples, shape, most):
    rng = np.random.default_rng(samples)
    spectrum = band_limited(rng, *shape)
    by = np.array([[0, 0], *rng.uniform(-4, 4, (3, 2)), [1, -2], [0.5, -0.5]])
    images = np.stack([shift_spectrum(spectrum, shape, *d) for d in by], axis=1)
    first, second = np.triu_indices(len(by), 1)
    near = np.abs(by[second] - by[first]).max(1) < 5
    pairs, band = (first[near], second[near]), most or full_band(*shape)
    shifts = measure_shifts(images, shape, pairs, band, 5, samples)
    correlation = phase_only_correlation(images, shape, pairs, band, range(-3, 5), range(-2, 2))
    want = twin_correlation(*(images.swapaxes(0, 1)[some] for some in pairs), *band)
    want = want[:, np.arange(-3, 5)[:, None], np.arange(-2, 2)]
    assert_allclose(correlation, want.swapaxes(0, 1), atol=2e-6)
    # The images are float32: 3e-7 px were seen with the full band. The less band, the flatter the peak, and
    # the last step, below 1e-3 px, leaves more.
    assert_allclose(shifts, by[pairs[1]] - by[pairs[0]], atol=2e-6 if most is None else 2e-5)


@pytest.mark.parametrize(("down", "across", "most"), [(12, 4, (2, 4)), (4, 40, (6, 1)), (0.5, 0.5, (23, 15))])
def test_blobs_fill_half_a_cycle_a_blob_size(down, across, most):
    """Never less than one harmonic, nor more than there are; a blob is a pixel at the least."""
    blob = np.outer(box(24, down, 49), box(16, across, 33))
    assert blob_band(np.float32(blob)[:, None], (48, 32)) == most


def view_of(maps):
    """A frame of which only the pixel maps are told."""
    none = np.zeros((len(maps), 1, 1), np.float32)
    presence = PresenceMap(none, 2, none > 0, maps.astype(np.float32))
    soft = SoftSymbols(np.zeros(len(maps), np.int64), np.zeros((len(maps), 6), np.float32), 1.0)
    return FrameView(np.zeros((32, *maps.shape[1:]), np.int16), np.zeros((2, 32)), presence, soft)


def image_of(bar, distance_m, *, tilt_deg=0.0, blob="gaussian", offset=(0.2, -0.3), moved=None):
    """Maps of a bar rolled by an angle: a blob a cluster, integrated over each pixel's area."""
    scale = CAMERA.focal_px / distance_m
    metres = bar.cluster_centres_m()
    pitch = scale * np.linalg.norm(metres[1] - metres[0])
    angle = np.radians(tilt_deg)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    centres = scale * metres @ turn
    columns, rows = np.ceil(np.ptp(centres, axis=0) + 2 * pitch + 20).astype(int)
    centres += [(columns - 1) / 2 + offset[0], (rows - 1) / 2 + offset[1]]
    for cluster, by in (moved or {}).items():
        centres[cluster] += by
    shape, sizes = (gaussian, (0.3 * pitch,) * 2) if blob == "gaussian" else (box, (pitch, 4.0))
    maps = np.array([np.outer(shape(y, sizes[0], rows), shape(x, sizes[1], columns)) for x, y in centres])
    # A map is zero away from its cluster.
    return np.where(maps > 1e-4 * maps.max(), maps / maps.max(), 0)


def measure(maps, bar=BAR, **parameters):
    return PocRanging(**parameters).compile(CAMERA, bar, LINK.codebook)(view_of(maps))


# Relative errors seen are a third of this. Gaussians are all but band-limited; boxes are not, and edges that
# fall between pixels shift their peaks by some 0.01 px. A panel is a quarter as long as the bar.
@pytest.mark.parametrize(("band", "tilt_deg"), [("full", 7), ("blob", 0), ("blob", -30), ("blob", 90)])
@pytest.mark.parametrize(
    ("bar", "blob", "tolerance"), [(BAR, "gaussian", 1e-3), (BAR, "box", 5e-3), (PANEL, "gaussian", 5e-3)]
)
def test_distance_of_ideal_images(bar, blob, tolerance, tilt_deg, band):
    measure = PocRanging(band=band).compile(CAMERA, bar, LINK.codebook)
    distances = np.arange(30, 101, 10.0)
    got = [measure(view_of(image_of(bar, d, tilt_deg=tilt_deg, blob=blob))) for d in distances]
    found = np.array([r.distance_m for r in got])
    assert_allclose(found, distances, rtol=tolerance)
    assert (np.diff(found) > 0).all()
    # Of a panel, they have the rim's, a fifth of a pixel; its clusters are 4 cm apart.
    rim_m = 0.0 if bar is BAR else 0.2 * distances**2 / (CAMERA.focal_px * 0.04)
    assert (np.array([r.sigma_m for r in got]) < tolerance * 100 + rim_m).all()
    # Of 28, and of 9 of the panel; extremes and outliers are dropped.
    assert min(r.pairs for r in got) >= (16 if bar is BAR else 5)


@pytest.mark.parametrize(
    ("dark", "pairs"),
    [((1, 2, 3), 21), (range(4, 12), 9), (range(5, 13), 8), ((*range(4), *range(11, 16)), 6)],
)
def test_a_distance_needs_its_pairs(dark, pairs):
    maps = image_of(BAR, 50)
    maps[list(dark)] = 0
    assert measure(maps, min_pairs=1, drop_extremes=0, outlier_iqr=1e6).pairs == pairs
    assert np.isnan(measure(maps).distance_m) == (pairs < 7)


@pytest.mark.parametrize("cluster", [2, 5, 12])
@pytest.mark.parametrize("down", [3, -3])
def test_a_cluster_out_of_place_is_dropped(cluster, down):
    maps = image_of(BAR, 50, moved={cluster: (0, down)})
    found = measure(maps)
    everything = measure(maps, drop_extremes=0, outlier_iqr=1e6)
    assert found.distance_m == pytest.approx(50, rel=1.5e-3)
    assert abs(everything.distance_m / 50 - 1) > 2.5e-3
    assert everything.sigma_m > 2 * found.sigma_m
    centroid = CentroidRanging().compile(CAMERA, BAR, LINK.codebook)(view_of(maps))
    # Neither the ends nor it.
    assert (centroid.distance_m, centroid.pairs) == (pytest.approx(50, rel=1.5e-3), 13)


def test_sigma_is_the_error_that_noise_makes():
    rng, maps = np.random.default_rng(8), image_of(BAR, 70)
    noisy = (np.clip(maps + rng.normal(0, 0.1, maps.shape), 0, 1) * (maps > 0) for _ in range(60))
    distance_m, sigma_m = np.array([(r.distance_m, r.sigma_m) for r in map(measure, noisy)]).T
    assert 0.5 < sigma_m.mean() / distance_m.std() < 2


def test_centroid_leaves_out_the_rim_of_a_panel():
    """Clusters of the rim look further out than they are; the inner four tell the scale."""
    maps = image_of(PANEL, 30)
    moved = maps.copy()
    for side, axis, px in ((1, 1, -1), (2, 1, 1), (4, 2, -1), (8, 2, 1)):
        rim = PANEL.lit_sides & side == 0
        assert rim.sum() == 4
        moved[rim] = np.roll(moved[rim], px, axis=axis)
    inner, every = (CentroidRanging(skip_outer=n).compile(CAMERA, PANEL, LINK.codebook) for n in (1, 0))
    assert inner(view_of(moved)) == inner(view_of(maps))
    assert inner(view_of(maps)).distance_m == pytest.approx(30, rel=5e-3)
    assert every(view_of(moved)).distance_m < 0.97 * every(view_of(maps)).distance_m


NOT_OF_THE_BAR = r"ranging\.clusters = .*two or more different clusters of 0 to 15"
CROSS = LedTable(((1, 0, 0, 0), (-1, 0, 0, 0), (0, 1, 0, 1), (0, -1, 0, 1)))


@pytest.mark.parametrize(
    ("bar", "parameters", "message"),
    [
        *((BAR, {"clusters": some}, NOT_OF_THE_BAR) for some in ((3,), (3, 3), (2, 5, 2), (-1, 5), (2, 16))),
        (BAR, {"skip_outer": 8}, "skip_outer = 8: leaves 0 of 16"),
        (BAR, {"skip_outer": 20}, "set ranging.skip_outer = 7$"),
        (BarLayout(LedGrid(rows=24)), {"skip_outer": 2}, "set ranging.skip_outer = 1$"),
        (BarLayout(CROSS), {}, "apart"),
        (BarLayout(LedGrid(rows=6)), {}, "needs two clusters"),
    ],
)
def test_other_clusters_and_too_few_are_refused(bar, parameters, message):
    with pytest.raises(ConfigError, match=message):
        PocRanging(**{"skip_outer": 0, **parameters}).compile(CAMERA, bar, LINK.codebook)


def test_extremes_of_both_sides_and_outliers_are_left_out():
    first, second = np.triu_indices(6, 1)
    values, apart = 50 + 0.01 * np.arange(15), (second - first).astype(float)
    values[[0, 5, 9]] = 40, 70, 51
    beyond = np.stack([apart / values, np.zeros(15)], axis=1)
    nowhere, pairs = np.zeros((6, 2), np.int64), (first, second, apart)

    def mean(scale, least):
        return _kernels.mean_distance(nowhere, beyond, pairs, 1.0, (scale, 0.5, least), (2.0, 1, 1.5))

    rest = np.delete(np.arange(15), [0, 5, 9])
    want = np.average(values[rest], weights=apart[rest] ** 2)
    assert mean(0.0, 15) == pytest.approx((want, jackknife(values, apart**2, first, second, rest), 12))
    # Two clusters farther apart than half a metre are out of place; too few are left, then.
    assert np.isnan(mean(1.0, 1)[0])


def soft_box(centre, width, blur, size):
    """A box blurred by a Gaussian, the mean over each pixel of a line by 16 samples; and its slope."""
    x = (np.arange(16 * size) + 0.5) / 16 - 0.5 - centre
    left, right = norm(-width / 2, blur), norm(width / 2, blur)
    value, slope = left.cdf(x) - right.cdf(x), right.pdf(x) - left.pdf(x)
    return value.reshape(size, 16).mean(1), slope.reshape(size, 16).mean(1)


@pytest.mark.parametrize(("spacing_px", "noise"), [(14.4, 0.05), (8.6, 0.1), (6.2, 0.05), (4.8, 0.1)])
def test_a_shift_in_noise_and_its_bound(spacing_px, noise):
    """The full band errs by 5 times the Cramer-Rao bound and more, the blobs' band by 2.5 at the most."""
    rng = np.random.default_rng(round(10 * spacing_px))
    pairs, rows, columns = 300, 2 * int(spacing_px + 4), 16
    by = rng.uniform(-0.5, 0.5, (pairs, 2))
    at = np.repeat(rng.uniform(-0.5, 0.5, (pairs, 2)), 2, axis=0)
    at[1::2] += by
    down = [soft_box(rows // 2 + v, spacing_px, 0.6, rows) for v, _ in at]
    across = [soft_box(columns // 2 + u, 3.0, 0.6, columns) for _, u in at]
    images = np.array([np.outer(v, u) for (v, _), (u, _) in zip(down, across, strict=True)])
    slopes = np.array([np.outer(v, u) for (_, v), (u, _) in zip(down, across, strict=True)])
    # Two images in white noise, each of known shape: the variances of their places add up.
    information = (slopes**2).sum((1, 2)) / noise**2
    bound = np.sqrt((1 / information).reshape(pairs, 2).sum(1).mean())
    noisy = (images + rng.normal(0, noise, images.shape)).astype(np.float32).swapaxes(0, 1)
    first, size, ratio = 2 * np.arange(pairs), (rows, columns), {}
    blob = blob_band(images.swapaxes(0, 1), size)
    for name, most in {"full": full_band(rows, columns), "blob": blob}.items():
        shifts = measure_shifts(noisy, size, (first, first + 1), most, 4, 2)
        ratio[name] = np.sqrt(((shifts[:, 0] - by[:, 0]) ** 2).mean()) / bound
    # Seen: 4.9 to 6.7, and 1.3 to 2.5.
    assert ratio["full"] > 4
    assert 1 < ratio["blob"] < 2.8
