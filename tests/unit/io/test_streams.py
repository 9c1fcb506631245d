"""Streams from sockets, and recordings again and again, give what is in the file."""

import os
import socket
import threading
import time
from contextlib import contextmanager, suppress

import numpy as np
import pytest

from evlcp_sdk.errors import InputError
from evlcp_sdk.io import LoopSource, StreamSource, open_source, write_events
from evlcp_sdk.io.streams import SocketReader
from evlcp_sdk.values import Events

EVENTS = Events.of(np.arange(3000) * 7, np.arange(3000) % 640, np.arange(3000) % 480, np.arange(3000) % 2)


@pytest.fixture(params=["EVT2", "EVT3"])
def recording(request, tmp_path):
    path = tmp_path / f"{request.param}.raw"
    write_events(path, EVENTS, 640, 480, format=request.param)
    return path


@contextmanager
def sent(listening, data):
    """One who connects is sent some bytes, in odd pieces."""

    def send():
        connection, _ = listening.accept()
        with connection:
            for at in range(0, len(data), 1001):
                connection.sendall(data[at : at + 1001])

    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    with listening:
        yield
        thread.join(5)


def same(events):
    return all((getattr(events, name) == getattr(EVENTS, name)).all() for name in ("t_us", "x", "y", "p"))


@pytest.mark.parametrize("how", ["tcp", "unix", "without a header"])
def test_a_stream_gives_what_is_in_the_file(how, recording, tmp_path):
    data = recording.read_bytes()
    if how == "unix":
        listening, url = socket.socket(socket.AF_UNIX), f"unix:{tmp_path / 's'}"
        listening.bind(str(tmp_path / "s"))
        listening.listen()
    else:
        listening = socket.create_server(("localhost", 0))
        url = f"tcp://localhost:{listening.getsockname()[1]}"
    if how == "without a header":
        data, url = data.partition(b"% end\n")[2], f"{url}?evt={recording.stem[-1]}&size=640x480"
    with sent(listening, data), open_source(url) as source:
        assert (source.live, source.format) == (True, recording.stem)
        assert (source.width, source.height) == (640, 480)
        assert same(source.read()[0])
        assert source.losses == {}


def test_datagrams_are_read_as_they_come(recording):
    header, _, words = recording.read_bytes().partition(b"% end\n")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("localhost", 0))
        port = probe.getsockname()[1]

    def send():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.connect(("localhost", port))
            # The second is refused as long as nobody listened for the first.
            greeted = False
            while not greeted:
                time.sleep(0.01)
                with suppress(ConnectionRefusedError):
                    sender.send(header + b"% end\n")
                    greeted = sender.send(header + b"% end\n") > 0
            # A header before every second piece, for whoever begins to listen later.
            for n, at in enumerate(range(0, len(words), 1400)):
                if n % 2 == 0:
                    sender.send(header + b"% end\n")
                sender.send(words[at : at + 1400])

    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    with open_source(f"udp://localhost:{port}") as source:
        assert source.format == recording.stem
        got = Events.empty()
        for events, _ in source.stream():
            got = Events.concat([got, events])
            if len(got) == len(EVENTS):
                break
    thread.join(5)
    assert same(got)


def test_a_read_ends_when_the_source_is_closed(recording):
    ours, theirs = socket.socketpair()
    theirs.sendall(recording.read_bytes())
    with ours, theirs, StreamSource("a", file=SocketReader(ours)) as source:
        got = []
        for events in source.chunks():
            got.append(events)
            if sum(map(len, got)) == len(EVENTS):
                # Of a read that waits for more.
                threading.Timer(0.2, source.close).start()
    assert same(Events.concat(got))


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("tcp://localhost:1", "Connection refused; expected a program that sends there"),
        ("tcp://localhost", "expected tcp://HOST:PORT"),
        ("udp://localhost:99999", "expected udp://HOST:PORT"),
        ("udp://192.0.2.1:5600", "expected an address of this machine"),
        ("unix:/no/such", "expected a socket that a program listens on"),
        ("tcp://localhost:1?evt=4", "evt = '4': expected 2, 2.1 or 3"),
    ],
)
def test_what_is_wrong_with_a_stream_is_reported(url, message):
    with pytest.raises(InputError) as fault:
        open_source(url)
    assert str(fault.value).startswith(url)
    assert message in str(fault.value)


def test_a_pipe_in_the_dark_is_opened_at_once(recording):
    """The header is enough; events come when there are any."""
    end, start = os.pipe()
    header, mark, words = recording.read_bytes().partition(b"% end\n")
    os.write(start, header + mark)
    with open_source(f"/dev/fd/{end}") as source:
        assert source.width == 640
        os.write(start, words[:5000])
        os.close(start)
        assert len(source.read()[0]) > 100
    os.close(end)


def test_a_loop_goes_on_with_its_clock(tmp_path):
    table = {"t_us": [1000, 2000, 3000, 4000], "x": [1, 2, 700, 3], "y": [0] * 4, "p": [1] * 4}
    edge = {"trigger_t_us": [4500], "trigger_channel": [1], "trigger_value": [1]}
    np.savez(tmp_path / "a.npz", width=640, height=480, **table, **edge)
    with LoopSource(lambda: open_source(tmp_path / "a.npz"), for_us=600_000) as source:
        got, triggers = source.read()
    assert got.t_us.tolist() == [shift + t for shift in (0, 503_500, 1_007_000) for t in (1000, 2000, 4000)]
    assert got.x.tolist() == [1, 2, 3] * 3
    assert triggers.t_us.tolist() == [4500, 508_000, 1_011_500]
    assert source.counts == {"events": 9, "triggers": 3}
    assert source.losses["outside_sensor"].count == 3
