"""EVT2 and EVT3 decoded word by word in plain Python, straight from the description of the formats."""

import struct


class Decoded:
    """What a stream holds: events (t, x, y, p), triggers (t, channel, value), and what went wrong.

    Losses by kind are how many, and the byte offset of the first.
    """

    def __init__(self):
        self.events, self.triggers, self.losses = [], [], {}
        self.rollovers = self.last = 0
        self.early = 0  # steps back over a rollover

    def lose(self, kind, at):
        before, first = self.losses.get(kind, (0, at))
        self.losses[kind] = (before + 1, first)

    def add(self, rows, row, at):
        if row[0] < self.last:
            self.lose("time_backward", at)
        else:
            self.last = row[0]
            rows.append(row)

    def add_event(self, t, x, y, p, at, width, height):
        if x >= width or y >= height:
            self.lose("outside_sensor", at)
        else:
            self.add(self.events, (t, x, y, p), at)


def judge_time_high(words, k, bits, low_bits, before):
    """Whether TIME_HIGH words[k] is believed after `before`, `early` by little, or not believed."""
    ring, size = 1 << bits, (bits + 4) // 8
    ahead = (words[k] - before) % ring
    if ahead <= 1:
        return "believed"
    back_us = (ring - ahead) << low_bits
    if back_us <= 10_000:
        return "early"
    near = words[k + 1 : k + 1 + (1 << 18) // size]
    following = [w % ring for w in near if w >> bits == 8][: 3 if ahead > 3 else 1]
    against = sum((n - before) % ring < ahead for n in following)
    if against > len(following) - against:
        return "doubtful"
    repeated = back_us <= 100_000 and words[k] % ring << low_bits > 10_000
    return "early" if repeated else "believed"


def doubtful(out, words, k, bits, low_bits, before, at):
    """Count what TIME_HIGH words[k] is after `before`; whether it is not believed."""
    verdict, value = judge_time_high(words, k, bits, low_bits, before), words[k] % (1 << bits)
    if verdict != "believed":
        out.lose("time_glitches", at)
    out.rollovers += verdict == "believed" and value < before
    out.early += verdict == "early" and value > before
    return verdict == "doubtful"


def decode_evt3(data, width, height, start=0):
    out = Decoded()
    high = row = base = None
    low = polarity = 0
    vector_at, vector_left = 0, 0
    doubt = False
    words = [word for (word,) in struct.iter_unpack("<H", data[: len(data) // 2 * 2])]
    for k, word in enumerate(words):
        at = start + 2 * k
        kind, value = word >> 12, word & 0xFFF
        if high is None:
            if kind == 0x8:
                high = value
            else:
                out.lose("words_before_time", at)
            continue
        t = (out.rollovers - out.early) * 2**24 + high * 2**12 + low
        if kind == 0x0:
            row = value & 0x7FF
        elif kind == 0x2:
            if doubt:
                out.lose("time_doubtful", at)
            elif row is None:
                out.lose("row_unknown", at)
            else:
                out.add_event(t, value & 0x7FF, row, value >> 11, at, width, height)
        elif kind == 0x3:
            if vector_left:
                out.lose("vectors_cut", vector_at)
            base, polarity = value & 0x7FF, value >> 11
            vector_at, vector_left = at, 3
        elif kind in (0x4, 0x5):
            size = 12 if kind == 0x4 else 8
            vector_left = max(vector_left - 1, 0) if kind == 0x4 else 0
            for bit in range(size):
                if not value >> bit & 1:
                    continue
                if doubt:
                    out.lose("time_doubtful", at)
                elif row is None:
                    out.lose("row_unknown", at)
                elif base is None:
                    out.lose("column_unknown", at)
                else:
                    out.add_event(t, base + bit, row, polarity, at, width, height)
            if base is not None:
                base += size
        elif kind == 0x6:
            low = value
        elif kind == 0x8:
            doubt = doubtful(out, words, k, 12, 12, high, at)
            if not doubt and value != high:
                high, low = value, 0
        elif kind == 0xA and doubt:
            out.lose("time_doubtful", at)
        elif kind == 0xA:
            out.add(out.triggers, (t, value >> 8 & 0xF, value & 1), at)
        elif kind in (0x1, 0x9, 0xB, 0xC, 0xD):
            out.lose("reserved_words", at)
    if vector_left:
        out.lose("vectors_cut", vector_at)
    return out


def decode_evt2(data, width, height, start=0):
    words = [word for (word,) in struct.iter_unpack("<I", data[: len(data) // 4 * 4])]
    return _decode(words, [1] * len(words), range(start, start + len(data), 4), width, height)


def decode_evt21(data, width, height, start=0):
    """As an IMX636 has them: in bits of columns, 0 the lowest."""
    words = list(struct.iter_unpack("<II", data[: len(data) // 8 * 8]))
    heads, masks = [word for word, _ in words], [mask for _, mask in words]
    return _decode(heads, masks, range(start, start + len(data), 8), width, height)


def decode_evt21_little(data, width, height, start=0):
    """As a GenX320 has them: 64 bits, the type in the highest four."""
    words = [word for (word,) in struct.iter_unpack("<Q", data[: len(data) // 8 * 8])]
    heads, masks = [word >> 32 for word in words], [word & 0xFFFFFFFF for word in words]
    return _decode(heads, masks, range(start + 4, start + len(data), 8), width, height)


def _decode(words, masks, places, width, height):
    out = Decoded()
    high = None
    doubt = False
    for k, (word, mask, at) in enumerate(zip(words, masks, places, strict=True)):
        kind = word >> 28
        if kind == 0x8:
            doubt = high is not None and doubtful(out, words, k, 28, 6, high, at)
            high = high if doubt else word & 0xFFFFFFF
            continue
        if high is None:
            out.lose("words_before_time", at)
            continue
        t = (out.rollovers - out.early) * 2**34 + high * 64 + (word >> 22 & 0x3F)
        columns = [word >> 11 & 0x7FF] if kind == 0xA else []
        if kind in (0x0, 0x1):
            columns = [(word >> 11 & 0x7FF) + bit for bit in range(32) if mask >> bit & 1]
        if doubt and columns:
            for _ in columns:
                out.lose("time_doubtful", at)
        elif kind in (0x0, 0x1):
            for x in columns:
                out.add_event(t, x, word & 0x7FF, kind, at, width, height)
        elif kind == 0xA:
            out.add(out.triggers, (t, word >> 8 & 0x1F, word & 1), at)
        elif kind not in (0xE, 0xF):
            out.lose("reserved_words", at)
    return out


TWINS = {"EVT3": decode_evt3, "EVT2": decode_evt2, "EVT21": decode_evt21, "little": decode_evt21_little}
