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


def max_log(fit, bits):
    zero, one = np.full((2, len(fit), bits), -np.inf)
    for (k, s), f in np.ndenumerate(fit):
        for b, bit in enumerate(f"{s:0{bits}b}"):
            side = one if bit == "1" else zero
            side[k, b] = max(side[k, b], f)
    return zero, one


def llr(values, words):
    """Symbols, ln P(bit 0) / P(bit 1), and share of energy explained: nearest words at each one's amplitude.

    The amplitude is that of the least-squares fit; all clusters have one noise.
    """
    amplitude = np.array([max(w @ v / len(w) for w in words) for v in values])
    cost = np.array(
        [[((v - a * w) ** 2).sum() for w in words] for v, a in zip(values, amplitude, strict=True)]
    )
    rest, kept = cost.min(1).sum(), (amplitude**2).sum() * words.shape[1]
    variance = rest / values.size
    bits = len(words).bit_length() - 1
    out = np.empty((len(values), bits))
    for k, b in np.ndindex(out.shape):
        zeros = [f"{s:0{bits}b}"[b] == "0" for s in range(len(words))]
        out[k, b] = (cost[k, np.invert(zeros)].min() - cost[k, zeros].min()) / (2 * variance)
    return cost.argmin(1), out, kept / (kept + rest)
