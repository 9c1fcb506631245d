"""Lists of events of one LED outdoors: wrong bits of `uart` beside a plain and a told receiver.

    python benchmarks/lists.py [--seeds 1 2] [--characters 400] [--only NAME ...]
        [--lamp sine100|sine120|square100 ...] [--strength 0.1 1 ...]

Pixels as in the sensor's model (logarithmic receptor with a lag, thresholds, refractory time, missing events,
latencies with jitter, noise) look at one LED that sends 7 data bits, highest first, even parity and two stop
bits; their events are merged by time. The plain receiver sums events with a leak, takes two thresholds (the
best of four pairs) and samples the middles of bits between falling edges. The told one is given when each
character starts, and learns from the other half of the characters what events come after which bits; what it
gets wrong is in the events.

`--lamp` lets a lamp shine on the same pixels, so many times as bright at its brightest as the background: the
square of a sine, 100 or 120 times a second, or a square wave. The told receiver is then told its phase,
too, and learns each eighth of its period apart.
"""

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from evlcp_uart.characters import Characters
from evlcp_uart.framing import Uart, read_characters
from evlcp_uart.light import CONTEXTS, GAINS, OUTLIER, TICKS, Light
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
LAMP_STEP_US, PHASES = 100.0, 8
LAMPS = {"sine100": 10_000.0, "sine120": 1e6 / 120, "square100": 10_000.0}
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


def lit_by(lamp: str, end_us: float) -> list[tuple[float, float]]:
    """From when on a lamp is how bright, of its brightest."""
    period_us = LAMPS[lamp]
    if lamp.startswith("square"):
        return [(k * period_us / 2, float(k % 2)) for k in range(math.ceil(2 * end_us / period_us))]
    at = np.arange(0, end_us, LAMP_STEP_US)
    return list(zip(at.tolist(), (np.sin(np.pi * at / period_us) ** 2).tolist(), strict=True))


def seen(
    rng: np.random.Generator,
    light: Sequence[Edge],
    end_us: float,
    pixels: Pixels,
    lamp: tuple[str, float] | None = None,
) -> Pulses:
    """Times and polarities of what pixels make of the edges, ascending."""
    found: list[tuple[float, bool]] = []
    # Until when the LED is on or off, and how bright the background is.
    parts, shares, on, share = [], [(end_us, 0.0)], True, 0.0
    if lamp is not None:
        shares = [(t_us, 1 + lamp[1] * value) for t_us, value in lit_by(lamp[0], end_us)] + shares
    changes = sorted([(t_us, True, float(lit)) for t_us, lit in light] + [(t, False, v) for t, v in shares])
    share = 1.0
    for t_us, of_led, value in changes:
        parts.append((t_us, on, pixels.background * share))
        on, share = (bool(value), share) if of_led else (on, value)
    for contrast in pixels.contrasts:
        thresholds = np.maximum(THRESHOLD * (1 + THRESHOLD_SPREAD * rng.standard_normal(2)), 0.05)
        lit = pixels.background * (1 + contrast)
        inverse, now, blind = 1 / lit, 0.0, 0.0
        reference = math.log(lit)
        for next_us, is_on, background in parts:
            level = background + pixels.background * contrast * is_on
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


def told(
    events: Pulses, values: NDArray[np.int64], bit_us: float, start_us: float, lamp_us: float = 0.0
) -> float:
    """Share of the data bits that the told receiver gets wrong; where bits begin is the best of four.

    With the period of a lamp it is told its phase, too: it learns each eighth of the period apart.
    """
    characters: Characters = UART.characters
    tick_us, word = bit_us / TICKS, BITS * TICKS
    ticks = (events[0] / tick_us).astype(np.int64)
    counts = np.zeros((2, max(int(ticks.max()), round(start_us / tick_us) + word * len(values)) + 2 * word))
    np.add.at(counts, (events[1].astype(np.int64), ticks), 1)
    contexts, best = characters.contexts[values], 1.0
    for shift in (-5, -3, -1, 1):
        starts = start_us / tick_us + shift + word * np.arange(len(values))
        at = np.rint(starts[:, None] + TICKS * np.arange(BITS)).astype(np.int64)
        windows = counts[:, at[..., None] + np.arange(TICKS)].transpose(1, 2, 0, 3)
        phases = np.zeros(at.shape, np.int64)
        if lamp_us:
            phases = np.floor(at * tick_us / lamp_us * PHASES).astype(np.int64) % PHASES
        wrong = 0
        for half in (0, 1):
            known = np.arange(len(values)) % 2 == half
            said = np.zeros((int((~known).sum()), BITS, CONTEXTS))
            for phase in np.unique(phases[~known]).tolist():
                taught, here = phases[known] == phase, phases[~known] == phase
                light = learned(windows[known][taught], contexts[known][taught])
                found = np.logaddexp.reduce(light.log_likelihoods(windows[~known][here]), 2)
                said[here] = np.logaddexp(found - found.max(1, keepdims=True), math.log(OUTLIER))
            read = characters.likelihoods(said).argmax(1)
            wrong += wrong_bits(read, values[~known])
        best = min(best, wrong / (7 * len(values)))
    return best


def learned(windows: NDArray[np.float64], contexts: NDArray[np.int64]) -> Light:
    """The light as bits of known contexts show it."""
    blank = np.full((CONTEXTS, 2, TICKS), windows.mean() if len(windows) else 1.0)
    light = Light(blank, np.ones(CONTEXTS), np.ones((CONTEXTS, len(GAINS))))
    for _ in range(6 if len(windows) else 0):
        light = light.learn(windows, np.eye(CONTEXTS)[contexts], 0.0, 1.0)
    return light


def wrong_bits(read: NDArray[np.int64], sent: NDArray[np.int64]) -> int:
    """How many bits differ."""
    return sum((a ^ b).bit_count() for a, b in zip(read.tolist(), sent.tolist(), strict=True))


@dataclass(frozen=True)
class Rates:
    """What the receivers get of one scene.

    Attributes:
        events: Events of an edge.
        plain: Wrong bits of the plain receiver, as a share.
        ours: Wrong bits of `uart`; a lost character counts half its bits.
        told: Wrong bits of the told one.
        phase: The same where it is told the lamp's phase, too.
        lost: Characters that `uart` does not give.
        of_nobody: Characters that it gives where none was sent.
    """

    events: float
    plain: float
    ours: float
    told: float
    phase: float
    lost: int
    of_nobody: int


def measure(name: str, seed: int, many: int, lamp: tuple[str, float] | None = None) -> Rates:
    """One scene, received by each."""
    bit_hz, pixels = SCENES[name]
    rng = np.random.default_rng(seed)
    text = (TEXT * (many // len(TEXT) + 1))[:many]
    bits, values = levels(text), np.frombuffer(text.encode(), np.uint8).astype(np.int64)
    bit_us = 1e6 / bit_hz * CLOCK
    start_us = 5000 + QUIET_BITS * bit_us
    light = edges(bits, bit_us, start_us)
    events = seen(rng, light, start_us + (bits.size + QUIET_BITS) * bit_us, pixels, lamp)
    found = read_characters(*events, bit_hz, UART)
    places = [(one.t_us - start_us) / (BITS * bit_us) for one in found]
    inside = {round(at): one for at, one in zip(places, found, strict=True) if abs(at - round(at)) < 0.2}
    read = [k for k in range(many) if k in inside]
    wrong = wrong_bits(np.array([inside[k].value for k in read], np.int64), values[read])
    lost = many - len(read)
    return Rates(
        len(events[0]) / len(light),
        plain(events, bits, bit_us, start_us),
        (wrong + 3.5 * lost) / (7 * many),
        told(events, values, bit_us, start_us),
        told(events, values, bit_us, start_us, LAMPS[lamp[0]]) if lamp else np.nan,
        lost,
        len(found) - len(read),
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--characters", type=int, default=400)
    parser.add_argument("--only", nargs="+", default=list(SCENES), choices=list(SCENES), metavar="NAME")
    parser.add_argument("--lamp", nargs="+", default=[], choices=list(LAMPS), help="Beside the LED.")
    parser.add_argument("--strength", type=float, nargs="+", default=[1.0], metavar="TIMES")
    args = parser.parse_args()
    lamps = [(lamp, strength) for lamp in args.lamp for strength in args.strength] or [None]
    phase = " told the lamp's phase |" if args.lamp else ""
    head = f"| scene | events an edge | plain | `uart` | told |{phase} lost | of nobody | s CPU |"
    print(head + "\n|" + "---|" * (head.count("|") - 1))
    for name, lamp in ((name, lamp) for name in args.only for lamp in lamps):
        begun = time.process_time()
        rates = [measure(name, seed, args.characters, lamp) for seed in args.seeds]
        mean = [
            np.mean([getattr(one, key) for one in rates])
            for key in ("events", "plain", "ours", "told", "phase")
        ]
        counted = f"{sum(one.lost for one in rates)} | {sum(one.of_nobody for one in rates)}"
        spent = time.process_time() - begun
        which = f"{name}, {lamp[0]} x {lamp[1]:g}" if lamp else name
        figures = " | ".join(f"{value:.2g}" for value in mean[1 : 5 if lamp else 4])
        print(
            f"| {which} | {mean[0]:.1f} | {figures} | {counted} | {spent:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
