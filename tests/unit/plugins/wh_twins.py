"""Separation and decoding once more, from the air interface and Bayes' rule, in NumPy or plain Python."""

import numpy as np


def values_of(sums):
    """b' = the second chip's sign; b'' = minus the first's, where the second is silent."""
    first, second = np.sign(sums[::2].astype(int)), np.sign(sums[1::2].astype(int))
    return np.where(second != 0, second, -first)


def cells_of(sums, grid):
    """Sums of whole grid cells, (chips, rows, columns)."""
    chips, height, width = sums.shape
    rows, columns = height // grid, width // grid
    whole = sums[:, : rows * grid, : columns * grid].astype(int)
    return whole.reshape(chips, rows, grid, columns, grid).sum((2, 4))


def posterior(sums, codes, grid, error, min_values):
    """Bayes' rule, a product of probabilities each cell and cluster; half the prior is on `no cluster`."""
    values = values_of(cells_of(sums, grid))
    out = np.zeros((len(codes), *values.shape[1:]))
    for r, c in np.ndindex(out.shape[1:]):
        seen = [(i, v) for i, v in enumerate(values[:, r, c]) if v]
        if len(seen) < min_values:
            continue
        nothing = 0.5 * 0.5 ** len(seen)
        joint = [np.prod([1 - error if code[i] == v else error for i, v in seen]) for code in codes]
        joint = 0.5 / len(codes) * np.array(joint)
        out[:, r, c] = joint / (joint.sum() + nothing)
    return out


def pixel_maps(sums, codes, grid, selected):
    fit = np.einsum("ki,ivu->kvu", codes, values_of(sums)) / codes.shape[1]
    _, rows, columns = selected.shape
    near = np.zeros_like(selected)
    padded = np.pad(selected, ((0, 0), (1, 1), (1, 1)))
    for r, c in np.ndindex(3, 3):
        near |= padded[:, r : r + rows, c : c + columns]
    mask = np.zeros(fit.shape, bool)
    mask[:, : rows * grid, : columns * grid] = near.repeat(grid, 1).repeat(grid, 2)
    return np.where(mask, np.maximum(fit, 0), 0)


def weighted_values(sums, probability, grid, least):
    values = cells_of(values_of(sums), grid)
    weight = np.where(probability >= least, probability, 0)
    return np.einsum("krc,irc->ki", weight, values)


def llr(values, words):
    """Symbols, ln P(bit 0) / P(bit 1), and share of energy explained: nearest words at the mean amplitude.

    The amplitudes are those of the least-squares fit; all clusters have one noise.
    """
    amplitude = np.array([max(w @ v / len(w) for w in words) for v in values])
    cost = np.array([[((v - amplitude.mean() * w) ** 2).sum() for w in words] for v in values])
    kept = (amplitude**2).sum() * words.shape[1]
    rest = sum(
        ((v - a * words[cost[k].argmin()]) ** 2).sum()
        for k, (v, a) in enumerate(zip(values, amplitude, strict=True))
    )
    variance = rest / values.size
    bits = len(words).bit_length() - 1
    out = np.empty((len(values), bits))
    for k, b in np.ndindex(out.shape):
        # Symbols beyond carry no bits.
        zeros = np.array([f"{s:0{bits}b}"[b] == "0" for s in range(2**bits)])
        carrying = cost[k, : 2**bits]
        out[k, b] = (carrying[~zeros].min() - carrying[zeros].min()) / (2 * variance)
    return cost.argmin(1), out, kept / (kept + rest)


def take_back(sums, path):
    reach = np.abs(path).max()
    seam = np.pad(sums, ((0, 0), (reach, reach), (reach, reach)))
    _, height, width = sums.shape
    return np.array(
        [
            seam[c, reach + path[c // 2, 0] :, reach + path[c // 2, 1] :][:height, :width]
            for c in range(len(sums))
        ]
    )


def match_words(values, words):
    """Nearest words, by how much those with a bit 0 fit better than those with 1, and what agrees."""
    fit, bits = values @ words.T, len(words).bit_length() - 1
    zero = np.array([[f"{s:0{bits}b}"[b] == "0" for b in range(bits)] for s in range(2**bits)])
    carrying = fit[:, : 2**bits, None]
    margins = np.where(zero, carrying, -np.inf).max(1) - np.where(zero, -np.inf, carrying).max(1)
    symbols = fit.argmax(1)
    agrees = np.sign(values) * words[symbols] > 0
    agreement = np.abs(values)[agrees].sum() / max(np.abs(values).sum(), 1e-9)
    return symbols, fit.max(1), margins, agreement
