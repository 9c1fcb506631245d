"""Events of one LED outdoors, by a model of its pixels, and a plain receiver to compare with.

Pixels as in the sensor's model (logarithmic receptor with a lag, thresholds, refractory time, missing events,
latencies with jitter, noise) look at one LED that sends 7 data bits, highest first, even parity and two stop
bits; their events are merged by time. The plain receiver sums events with a leak, takes two thresholds (the
best of four pairs) and samples the middles of bits between falling edges.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from evlcp_uart.framing import Uart, read_characters
from numpy.typing import NDArray

TEXT = (
    "Shall I compare thee to a summer's day? Thou art more lovely and more temperate: Rough winds do shake"
    " the darling buds of May, And summer's lease hath all too short a date; "
)
UART = Uart(7, "even", 2, first_bit="highest")
BITS = 11

Edge = tuple[float, bool]
Pulses = tuple[NDArray[np.int64], NDArray[np.uint8]]


@dataclass(frozen=True)
class Pixels:
    """What sees the light.

    Attributes:
        contrasts: Irradiance of the lit LED against the background, of each pixel.
        background: Irradiance without it, W/m2.
        lag_us: Lag of a pixel's bandwidth, beside the receptor's own.
        refractory_us: For which a pixel is blind after an event.
        noise_hz: Events of noise of a pixel, each sign half.
        missing: Share of OFF and of ON events that do not come.
    """

    contrasts: tuple[float, ...]
    background: float = 5.0
    lag_us: float = 0.0
    refractory_us: float = 150.0
    noise_hz: float = 1.0
    missing: tuple[float, float] = (0.2, 0.05)


THRESHOLD, THRESHOLD_SPREAD, CHARGE = 0.223, 0.1, 14.6
DELAYS_US, JITTER = (33.0, 22.0), 0.25
CLOCK = 1.003
QUIET_BITS = 40


def spot(contrast: float, many: int) -> tuple[float, ...]:
    """Contrasts of the pixels of a spot with soft edges."""
    return tuple(float(contrast * math.exp(-0.5 * x * x)) for x in np.linspace(0, 2.5, many))


SCENES: dict[str, tuple[float, Pixels]] = {
    "504 near": (504.0, Pixels(spot(8, 40))),
    "504 far": (504.0, Pixels(spot(0.8, 10))),
    "504 dim": (504.0, Pixels(spot(1.0, 8), noise_hz=12.0)),
    "3125 near": (3125.0, Pixels(spot(2, 10), lag_us=200.0, refractory_us=200.0)),
    "3125 noise": (3125.0, Pixels(spot(1, 8), noise_hz=60.0)),
    "3125 far": (3125.0, Pixels(spot(2, 10), lag_us=250.0, refractory_us=300.0)),
    "10000 near": (10_000.0, Pixels(spot(4, 20), lag_us=20.0, refractory_us=50.0)),
}


def levels(text: str) -> NDArray[np.int64]:
    """Bits on air, int64 (characters, 11), by the textbook."""
    rows = []
    for code in text.encode("ascii"):
        data = [int(bit) for bit in f"{code:07b}"]
        rows.append([0, *data, sum(data) % 2, 1, 1])
    return np.array(rows)


def edges(bits: NDArray[np.int64], bit_us: float, start_us: float) -> list[Edge]:
    """When the light goes on or off; before and behind it is on."""
    padded = np.concatenate([[1], bits.ravel(), [1]])
    at = np.flatnonzero(np.diff(padded))
    return [(start_us + k * bit_us, bool(padded[k + 1])) for k in at.tolist()]


def seen(
    rng: np.random.Generator,
    light: Sequence[Edge],
    end_us: float,
    pixels: Pixels,
) -> Pulses:
    """Times and polarities of what pixels make of the edges, ascending."""
    found: list[tuple[float, bool]] = []
    # Until when the LED is on or off.
    parts, on = [], True
    for t_us, lit in light:
        parts.append((t_us, on))
        on = lit
    parts.append((end_us, on))
    for contrast in pixels.contrasts:
        thresholds = np.maximum(THRESHOLD * (1 + THRESHOLD_SPREAD * rng.standard_normal(2)), 0.05)
        lit = pixels.background * (1 + contrast)
        inverse, now, blind = 1 / lit, 0.0, 0.0
        reference = math.log(lit)
        for next_us, is_on in parts:
            level = pixels.background * (1 + contrast * is_on)
            lag = CHARGE / level + pixels.lag_us
            while True:
                wake = max(now, blind)
                if wake >= next_us:
                    break
                if wake > now:
                    # Behind its refractory time a pixel takes the signal as it is.
                    inverse = 1 / level + (inverse - 1 / level) * math.exp(-(wake - now) / lag)
                    now, reference = wake, -math.log(inverse)
                rising = inverse > 1 / level
                target = reference + thresholds[1] if rising else reference - thresholds[0]
                inside = math.exp(-target)
                if (inside <= 1 / level) if rising else (inside >= 1 / level):
                    break
                wait = max(-lag * math.log((inside - 1 / level) / (inverse - 1 / level)), 0.0)
                if now + wait >= next_us:
                    break
                now += wait
                inverse, reference = inside, target
                if rng.random() >= pixels.missing[rising]:
                    found.append((now + DELAYS_US[rising] * math.exp(JITTER * rng.standard_normal()), rising))
                blind = now + pixels.refractory_us * math.exp(0.1 * rng.standard_normal())
            inverse = 1 / level + (inverse - 1 / level) * math.exp(-max(next_us - now, 0.0) / lag)
            now = max(now, next_us)
        noise = rng.uniform(0, end_us, rng.poisson(pixels.noise_hz * end_us * 1e-6))
        found += [(t, bool(rng.integers(2))) for t in noise.tolist()]
    found.sort()
    return np.array([int(t) for t, _ in found]), np.array([on for _, on in found], np.uint8)


def plain(events: Pulses, bits: NDArray[np.int64], bit_us: float, start_us: float) -> float:
    """Share of all bits, start, parity and stop included, that the plain receiver gets wrong at its best."""
    t_us, p = events
    many = max(float((np.diff(bits.ravel()) != 0).sum()) / 2, 1.0)
    leak = 2 * math.pi / 3 / bit_us
    kept = np.exp(-leak * np.diff(t_us, prepend=t_us[0]))
    sums, value = np.empty(len(t_us)), 0.0
    for k, (share, on) in enumerate(zip(kept.tolist(), p.tolist(), strict=True)):
        value = value * share + (1 if on else -1)
        sums[k] = value
    best = 1.0
    for rise, fall in ((0.25, 0.25), (0.5, 0.4), (0.12, 0.1), (0.5, 0.2)):
        is_on, is_off = sums > rise * p.sum() / many, sums < -fall * (1 - p.astype(int)).sum() / many
        at, on = t_us[is_on | is_off], is_on[is_on | is_off]
        falls = at[1:][~on[1:] & on[:-1]]
        if not len(falls):
            continue
        begin = float(falls[np.abs(falls - start_us).argmin()])
        wrong = 0
        for word in bits:
            due = begin + BITS * bit_us
            near = falls[(falls > due - 2 * bit_us) & (falls <= due + 0.5 * bit_us)]
            end = float(near[-1]) if len(near) else due
            middles = begin + (np.arange(BITS) + 0.5) * (end - begin) / BITS
            wrong += int((on[np.maximum(np.searchsorted(at, middles) - 1, 0)] != word).sum())
            begin = end
        best = min(best, wrong / bits.size)
    return best


def wrong_bits(read: NDArray[np.int64], sent: NDArray[np.int64]) -> int:
    """How many bits differ."""
    return sum((a ^ b).bit_count() for a, b in zip(read.tolist(), sent.tolist(), strict=True))


@dataclass(frozen=True)
class Rates:
    """What the receivers get of one scene.

    Attributes:
        plain: Wrong bits of the plain receiver, as a share.
        ours: Wrong bits of `uart`; a lost character counts half its bits.
        lost: Characters that `uart` does not give.
        of_nobody: Characters that it gives where none was sent.
    """

    plain: float
    ours: float
    lost: int
    of_nobody: int


def measure(name: str, seed: int, many: int) -> Rates:
    """One scene, received by each."""
    bit_hz, pixels = SCENES[name]
    rng = np.random.default_rng(seed)
    text = (TEXT * (many // len(TEXT) + 1))[:many]
    bits, values = levels(text), np.frombuffer(text.encode(), np.uint8).astype(np.int64)
    bit_us = 1e6 / bit_hz * CLOCK
    start_us = 5000 + QUIET_BITS * bit_us
    light = edges(bits, bit_us, start_us)
    events = seen(rng, light, start_us + (bits.size + QUIET_BITS) * bit_us, pixels)
    found = read_characters(*events, bit_hz, UART)
    places = [(one.t_us - start_us) / (BITS * bit_us) for one in found]
    inside = {round(at): one for at, one in zip(places, found, strict=True) if abs(at - round(at)) < 0.2}
    read = [k for k in range(many) if k in inside]
    wrong = wrong_bits(np.array([inside[k].value for k in read], np.int64), values[read])
    lost = many - len(read)
    return Rates(
        plain(events, bits, bit_us, start_us),
        (wrong + 3.5 * lost) / (7 * many),
        lost,
        len(found) - len(read),
    )
