"""The clock that is believed, event by event in plain Python."""

import numpy as np


def clock(rows, width, height):
    """What `CameraClock` keeps of events (t, x, y, p): rows inside, its counts, and first drops."""
    leap, setback, far = 1_000_000, 10_000, 2**62
    kept, held, last, offset = [], [], None, 0
    counts = dict.fromkeys(("backward", "off", "doubtful", "leaps", "restarts"), 0)
    firsts = {}

    def drop(name, *numbers):
        counts[name] += len(numbers)
        firsts[name] = min([*numbers, firsts.get(name, len(rows))])

    for number, row in enumerate(rows):
        t = row[0]
        if row[1] >= width or row[2] >= height:
            drop("off", number)
            continue
        if abs(t) > far:
            drop("doubtful", number)
            continue
        if last is None:
            last = offset = t
        if last <= t <= last + leap:
            drop("doubtful", *(k for k, _ in held))
            held, last = [], t
            kept.append((t - offset, *row[1:]))
        elif last - setback <= t < last or (held and held[-1][1][0] - setback <= t < held[-1][1][0]):
            drop("backward", number)
        else:
            if held and not held[-1][1][0] <= t <= held[-1][1][0] + leap:
                drop("doubtful", *(k for k, _ in held))
                held = []
            held.append((number, row))
            begin = held[0][1][0]
            if len(held) >= 16 and t - begin >= 10_000:
                counts["leaps" if begin > last else "restarts"] += 1
                offset = begin - (kept[-1][0] + 4_000_000)
                kept += [(h[0] - offset, *h[1:]) for _, h in held]
                held, last = [], t
    drop("doubtful", *(k for k, _ in held))
    return kept, counts, {name: first for name, first in firsts.items() if counts[name]}


def ordered(t_us, x, y, width, height):
    return bool(np.all(np.diff(t_us) >= 0) and np.all(x < width) and np.all(y < height))
