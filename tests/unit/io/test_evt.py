"""EVT2, EVT2.1 and EVT3: the kernels against their twins, any split of the words, and round trips."""

import numpy as np
import pytest
from evt_twins import TWINS
from hypothesis import given, settings, strategies as st

from evlcp_sdk.errors import StreamError
from evlcp_sdk.io import RawWriter, open_source, read_events, write_events
from evlcp_sdk.io.evt import EVT21_LITTLE, Decoder, EventBuffer
from evlcp_sdk.io.raw import CODECS
from evlcp_sdk.values import Events, Triggers

WIDTH, HEIGHT = 640, 480

types3 = st.sampled_from([0, 0, 2, 2, 2, 2, 3, 4, 4, 5, 6, 6, 8, 10, 14, 15, 7, 1, 9, 11, 12, 13])
word3 = st.builds(
    lambda kind, value, plain: [kind << 12 | (value & 0x80F if plain and kind not in (4, 5) else value)],
    types3,
    st.integers(0, 0xFFF),
    st.booleans(),
)
# Vectors, whole or cut: bases near the sensor's edge, near that of what 11 bits say, and beyond.
vector3 = st.builds(
    lambda base, masks, length: [0x3000 | base, *(0x4000 | m for m in masks[:2]), 0x5000 | masks[2] & 0xFF][
        :length
    ],
    st.integers(0, 600) | st.sampled_from([610, 630, 2016, 2017, 2040, 0x800]),
    st.lists(st.sampled_from([0, 0x111, 0xFFF]) | st.integers(0, 0xFFF), min_size=3, max_size=3),
    st.sampled_from([4, 4, 4, 1, 2, 3]),
)
words3 = st.builds(
    lambda start, parts: [word for part in (start, *parts) for word in part],
    st.sampled_from([[], [0x8000, 0x0005], [0x8000, 0x0005]]),
    st.lists(word3 | vector3, max_size=100),
)
words2 = st.builds(
    lambda kind, high, value, plain: (
        (kind << 28 | (value & 0x3FF if plain else high << 27 | value)) & 0xFFFFFFFF
    ),
    st.sampled_from([0, 1, 0, 1, 8, 8, 10, 14, 15, 2, 7, 9, 11, 13]),
    st.integers(0, 1),
    st.integers(0, 2**22 - 1).map(lambda v: v | (v & 7) << 24),
    st.booleans(),
)
pair2 = st.tuples(words2, st.sampled_from([0, 1, 1 << 31, 0xFFFFFFFF]) | st.integers(0, 2**32 - 1))
pairs2 = st.lists(pair2, max_size=120)
WORDS = {
    "EVT3": words3,
    "EVT2": st.lists(words2, max_size=120),
    "EVT21": pairs2.map(lambda pairs: [word for pair in pairs for word in pair]),
    "little": pairs2.map(lambda pairs: [word for pair in pairs for word in reversed(pair)]),
}
ALL_CODECS = CODECS | {"little": EVT21_LITTLE}


def decode(name, words, splits, capacity=64, at=0):
    """Decode words in the pieces that `splits` makes, into columns of `capacity`."""
    decoder = Decoder(ALL_CODECS[name], WIDTH, HEIGHT)
    events, triggers = [], []
    edges = sorted({0, len(words), *(s % (len(words) + 1) for s in splits)})
    start = 0
    for stop in edges[1:]:
        used = 1
        while start < stop and used:
            out = EventBuffer(capacity, 3)
            used = decoder.decode(words[start:stop], at + start * words.itemsize, out, stop == len(words))
            start += used // words.itemsize
            events.append(out.get_filled()[0])
            triggers.append(out.get_filled()[1])
    assert start == len(words)
    decoder.finish(at + words.nbytes, 0)
    return Events.concat(events), Triggers.concat(triggers), decoder


def rows(table, names):
    return list(zip(*(getattr(table, name).tolist() for name in names), strict=True))


@pytest.mark.parametrize("name", WORDS)
def test_kernel_equals_its_twin_for_any_words_and_splits(name):
    @settings(max_examples=200 if name == "EVT3" else 100)
    @given(WORDS[name], st.lists(st.integers(0, 200), max_size=4), st.integers(ALL_CODECS[name].burst, 120))
    def check(values, splits, capacity):
        codec = ALL_CODECS[name]
        array = np.array(values, codec.word)
        events, triggers, decoder = decode(name, array, splits, capacity, at=100)
        twin = TWINS[name](array.tobytes(), WIDTH, HEIGHT, 100)
        assert rows(events, ("t_us", "x", "y", "p")) == twin.events
        assert rows(triggers, ("t_us", "channel", "value")) == twin.triggers
        assert {kind: (loss.count, loss.first) for kind, loss in decoder.losses.items()} == twin.losses
        assert decoder.counts["rollovers"] == twin.rollovers

    check()


@st.composite
def recordings(draw, width, height, channels):
    """Events and triggers in any valid order, with runs that fit a vector, and their split into writes."""
    base = draw(st.sampled_from([0, 4090, (1 << 24) - 5, 1 << 24, 3 << 24, (1 << 34) - 9, (1 << 36) + 77]))
    columns = [[], [], [], []]
    t = base
    for _ in range(draw(st.integers(0, 12))):
        t += draw(st.sampled_from([0, 0, 1, 40, 64, 4096, 5000, 300_000]))
        y, p = draw(st.integers(0, height - 1)), draw(st.integers(0, 1))
        if draw(st.booleans()):
            start = draw(st.integers(0, width - 1))
            steps = draw(st.lists(st.sampled_from([0, 1, 1, 1, 2, 7]), max_size=40))
            xs = [x for x in np.cumsum([start, *steps]).tolist() if x < width]
        else:
            xs = draw(st.lists(st.integers(0, width - 1), min_size=1, max_size=3))
        for column, values in zip(columns, ([t] * len(xs), xs, [y] * len(xs), [p] * len(xs)), strict=True):
            column.extend(values)
    edges = sorted(base + draw(st.integers(0, 400_000)) for _ in range(draw(st.integers(0, 4))))
    ids = [draw(st.integers(0, channels - 1)) for _ in edges]
    values = [draw(st.integers(0, 1)) for _ in edges]
    cuts = sorted(draw(st.lists(st.integers(base, base + 400_000), max_size=3)))
    return Events.of(*columns), Triggers.of(edges, ids, values), cuts


def pieces(events, triggers, cuts):
    """The recording cut at times, as pairs."""
    n = [0, *np.searchsorted(events.t_us, cuts).tolist(), len(events)]
    m = [0, *np.searchsorted(triggers.t_us, cuts).tolist(), len(triggers)]
    for a, b, c, d in zip(n, n[1:], m, m[1:], strict=False):
        yield events[a:b], triggers[c:d]


@pytest.mark.parametrize("name", CODECS)
@pytest.mark.parametrize(("width", "height"), [(1280, 720), (33, 2), (7, 2048)])
def test_round_trip_is_the_identity(name, width, height, tmp_path_factory):
    path = tmp_path_factory.mktemp("round") / "trip.raw"
    codec = CODECS[name]

    @settings(max_examples=40)
    @given(recordings(width, height, codec.channels), st.integers(1, 50))
    def check(recording, max_events):
        events, triggers, cuts = recording
        with RawWriter(path, width, height, codec) as writer:
            for piece in pieces(events, triggers, cuts):
                writer.write(*piece)
        with open_source(path) as source:
            got = list(source.stream(max_events))
            assert all(len(e) <= max_events and len(g) <= max_events for e, g in got)
            assert (source.format, source.width, source.height) == (name, width, height)
            assert source.losses == {}
            assert source.position_bytes == source.size_bytes
            assert source.counts["events"] == len(events)
            assert source.counts["triggers"] == len(triggers)
        names = ("t_us", "x", "y", "p")
        assert rows(Events.concat(e for e, _ in got), names) == rows(events, names)
        names = ("t_us", "channel", "value")
        assert rows(Triggers.concat(g for _, g in got), names) == rows(triggers, names)

    check()


BAD_WRITES = {
    "an event earlier than the one before": (Events.of([5, 4], [0, 0], [0, 0], [0, 0]), None, "4 us after"),
    "an event before what was written": (Events.of([1], [0], [0], [0]), None, "at 1 us after 3 us"),
    "a time past 12 days": (Events.of([1 << 40], [0], [0], [0]), None, "expected 0 to"),
    "x outside": (Events.of([9], [1280], [0], [0]), None, "event 0: x is 1280, expected 0 to 1279"),
    "polarity": (Events.of([9], [0], [0], [2]), None, "p is 2, expected 0 to 1"),
    "channel": (Events.empty(), Triggers.of([9], [16], [0]), "channel is 16, expected 0 to 15"),
}


@pytest.mark.parametrize(("events", "triggers", "message"), BAD_WRITES.values(), ids=BAD_WRITES.keys())
def test_writer_refuses(events, triggers, message, tmp_path):
    path = tmp_path / "a.raw"
    with RawWriter(path, 1280, 720) as writer:
        if "at 1 us" in message:
            writer.write(Events.of([3], [0], [0], [0]))
        with pytest.raises(StreamError, match=message) as caught:
            writer.write(events, triggers)
    assert str(path) in str(caught.value)
    assert len(read_events(path)) == (1 if "at 1 us" in message else 0)  # nothing of the refused piece
    with pytest.raises(StreamError, match="closed"):
        writer.write(Events.empty())


def key(events):
    return ((events.t_us * WIDTH + events.x) * HEIGHT + events.y) * 2 + events.p


def crowd(n, until_us):
    """Events of all rows and columns, several of a row and time, so that EVT3 has vectors, too."""
    rng = np.random.default_rng(7)
    t = np.sort(rng.integers(0, until_us, n))
    x, y = rng.integers(0, WIDTH // 8, n) * 8, rng.integers(0, HEIGHT, n)
    many = rng.random(n) < 0.1
    wide = [Events.of(t, x, y, t & 1)] + [
        Events.of(t[many], x[many] + k, y[many], t[many] & 1) for k in range(1, 7)
    ]
    all_events = Events.concat(wide)
    return all_events[np.lexsort((all_events.x, all_events.y, all_events.t_us))]


BYTES = {
    "one is missing": (1, b""),
    "three are missing": (3, b""),
    "a sector but one is missing": (511, b""),
    "16 KiB come twice": (-16384, b""),
}


@pytest.mark.parametrize("name", CODECS)
@pytest.mark.parametrize("fault", BYTES)
def test_words_are_found_again_where_bytes_are_missing(name, fault, tmp_path):
    """Against the events that were written; what is lost ends with the next TIME_HIGH."""
    events = crowd(30_000, 200_000)
    known = key(events)
    path = tmp_path / "a.raw"
    write_events(path, events, WIDTH, HEIGHT, format=name)
    data = path.read_bytes()
    start = data.index(b"% end\n") + 6
    missing, more = BYTES[fault]
    askew = (len(more) - missing) % CODECS[name].size_bytes != 0
    # Events between two of them, of which an EVT2 file has one in 64 us; and those of the bytes themselves.
    # In EVT2.1 most other bytes look like types that exist, so that it is seen later.
    spare = 300 if name == "EVT21" else 100
    own = 2 * np.bincount(events.t_us >> (12 if name == "EVT3" else 6)).max() + max(missing, 0)
    for at in np.random.default_rng(3).integers(start + 20_000, len(data) - 3000, 6).tolist():
        path.write_bytes(data[:at] + more + data[at + missing :])
        with open_source(path) as source:
            got, losses = source.read()[0], source.losses
        right = np.isin(key(got), known)
        assert np.count_nonzero(right) >= len(events) - own - spare
        assert np.count_nonzero(~right) <= (spare if missing > 0 else own)
        assert len(got) <= len(events) + 100
        assert ("bytes_askew" in losses) == askew
        if askew:
            assert losses["bytes_askew"].count < CODECS[name].size_bytes
            assert -8 < losses["bytes_askew"].first - at < (600 if name != "EVT21" else 4000)
