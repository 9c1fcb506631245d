"""Where preambles are in a correlation, and when: by tables of all lags and of all that is left out."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

OUTSTANDS = 6.0
"""A correlation so many times the rms of a packet's others is a preamble: random data reach 5 in 20 s. The
rms is no less than one over the root of the events' number, which is that of random signs."""


def find_peaks(rho: Floats, first: int, guard: int, squares: Floats, least: float) -> list[int]:
    """Lags from the first on that correlate enough, best within `guard` on both sides; the first of equals.

    `squares` are the mean squares up to each; what is `OUTSTANDS` times their root is enough, from half of
    `least`, and `least` is in any case.
    """
    high = np.flatnonzero(rho[first : first + len(squares)] >= least / 2)
    high = first + high[rho[first + high] >= np.minimum(OUTSTANDS * np.sqrt(squares[high]), least)]
    found = []
    for lag in high.tolist():
        low = max(lag - guard, 0)
        if lag == low + int(rho[low : lag + guard + 1].argmax()):
            found.append(lag)
    return found


def time_preamble(
    counts: Floats, lag: int, chips: Floats, steps: int, pair: int, rising: NDArray[np.int64]
) -> tuple[list[float], list[float]]:
    """Times of a preamble found at a lag in counts of OFF and ON, float64 (2, bins), `steps` a chip.

    `pair` chips, a pair of pair codes, are left out together to see how sure the first two are; the third is
    by the chips that are `rising`.

    Returns:
        Where positive events fit best, and negative ones, NaN where none do; and where positive ones first
        reach half of their most, over what comes all the time; in steps. Their variances by the jackknife.
    """
    first, last = max(lag - steps, 0), min(lag + steps + 1, counts.shape[1] - steps * len(chips) + 1)
    running = np.zeros((2, last - first + steps * len(chips)))
    np.cumsum(counts[:, first : first + running.shape[1] - 1], axis=1, out=running[:, 1:])
    bounds = np.arange(last - first) + steps * np.arange(len(chips) + 1)[:, None]
    windows = running[:, bounds]
    # Of negative and positive events: what may be left out, by lags.
    values = np.array([[[-1.0]], [[1.0]]]) * chips[:, None] * (windows[:, 1:] - windows[:, :-1])
    if pair > 1:
        values = values.reshape(2, -1, pair, last - first).sum(2)
    (off, off_noise), (on, on_noise) = [_jackknife(_middles(_without_each(one))) for one in values]
    at = lag + steps * rising[:, None] + np.arange(-steps, steps)
    response = counts[1, np.clip(at, 0, counts.shape[1] - 1)]
    onset, onset_noise = _jackknife(_onsets(_without_each(response)))
    return [first + on, first + off, lag - steps + onset], [on_noise, off_noise, onset_noise]


def _without_each(parts: Floats) -> Floats:
    """The sum of parts (n, m), then the sums without each of them, (1 + n, m)."""
    out = np.empty((len(parts) + 1, parts.shape[1]))
    out[0] = parts.sum(0)
    np.subtract(out[0], parts, out=out[1:])
    return out


def _middles(fits: Floats) -> Floats:
    """Where correlations (n, lags) are best; NaN where one is positive nowhere.

    The top is flat where a window holds all events of an edge: its middle is the best window.
    """
    top = fits.max(1)
    weight = np.maximum(fits - 0.9 * top[:, None], 0)
    total = weight.sum(1)
    total[top <= 0] = np.nan
    found: Floats = weight @ np.arange(fits.shape[1]) / total
    return found


def _onsets(responses: Floats) -> Floats:
    """Where counts (n, steps) first reach half of their most, over what comes always: a quartile."""
    ordered = np.sort(responses, axis=1)
    half = (ordered[:, ordered.shape[1] // 4] + ordered[:, -1]) / 2
    k = (responses >= half[:, None]).argmax(1)
    rows = np.arange(len(responses))
    reached, below = responses[rows, k], np.where(k > 0, responses[rows, k - 1], 0.0)
    rises = reached > below
    found: Floats = k - 0.5 + rises * (half - below) / np.where(rises, reached - below, 1.0)
    return found


def _jackknife(found: Floats) -> tuple[float, float]:
    """What was found of all, and its variance by what was found without each; NaN of these says nothing."""
    whole, *without = found.tolist()
    without = [value for value in without if value == value]
    mean = sum(without) / max(len(without), 1)
    squares = sum([(value - mean) ** 2 for value in without])
    return whole, (len(without) - 1) * squares / max(len(without), 1) if without else 0.0
