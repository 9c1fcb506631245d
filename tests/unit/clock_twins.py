"""The clock that is believed, event by event in plain Python."""

import numpy as np


def clock(rows, width, height):
    """What `CameraClock` keeps of events (t, x, y, p): rows with times inside, and its counts."""
    leap, setback, far = 1_000_000, 10_000, 2**62
    kept, held, last, offset = [], [], None, 0
    counts = dict.fromkeys(("backward", "off", "doubtful", "leaps", "restarts"), 0)
    for row in rows:
        t = row[0]
        if row[1] >= width or row[2] >= height:
            counts["off"] += 1
            continue
        if abs(t) > far:
            counts["doubtful"] += 1
            continue
        if last is None:
            last = offset = t
        if last <= t <= last + leap:
            counts["doubtful"] += len(held)
            held, last = [], t
            kept.append((t - offset, *row[1:]))
        elif last - setback <= t < last or (held and held[-1][0] - setback <= t < held[-1][0]):
            counts["backward"] += 1
        else:
            if held and not held[-1][0] <= t <= held[-1][0] + leap:
                counts["doubtful"] += len(held)
                held = []
            held.append(row)
            if len(held) >= 16 and t - held[0][0] >= 10_000:
                counts["leaps" if held[0][0] > last else "restarts"] += 1
                offset = held[0][0] - (kept[-1][0] + 4_000_000)
                kept += [(h[0] - offset, *h[1:]) for h in held]
                held, last = [], t
    counts["doubtful"] += len(held)
    return kept, counts


def ordered(t_us, x, y, width, height):
    return bool(np.all(np.diff(t_us) >= 0) and np.all(x < width) and np.all(y < height))
