"""Opening: plugins first, then the readers; a scheme that nobody knows is named."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from evlcp_sdk.errors import ConfigError, InputError, PluginError, PluginWarning
from evlcp_sdk.io import EventSource, EventWriter, open_source, open_writer, read_events, write_events
from evlcp_sdk.io.open import is_recording
from evlcp_sdk.plugin.hooks import hookimpl
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.values import Events, Triggers

EVENTS = Events.of(np.arange(50) * 10, np.arange(50), np.arange(50), np.ones(50))


class CameraSource(EventSource):
    """A camera of a stranger's package: fifty events, then it is unplugged."""

    def __init__(self):
        super().__init__(Path("cam:0"), "CAMERA", 1280, 720)
        self.left = [(EVENTS, Triggers.empty())]

    def take(self, max_events):
        return self.left.pop() if self.left else None

    def close(self):
        pass


class Camera:
    """Opens that camera, and files that the SDK's own plugin would take; writes nothing well."""

    @hookimpl
    def evlcp_open_events(self, url):
        if url == "cam:broken":
            raise KeyError("no such device")
        if url == "cam:file":
            return Path("a.raw")
        return CameraSource() if url.startswith("cam:") or url.endswith(".dat") else None

    @hookimpl
    def evlcp_open_writer(self, path):
        if path.suffix == ".bad":
            raise KeyError("no room")
        return Events.empty() if path.suffix == ".odd" else None


@pytest.fixture
def installed(monkeypatch):
    """The camera's plugin, as if its package were installed."""
    load = Registry.load
    monkeypatch.setattr(Registry, "load", lambda *plugins: load(Camera(), *plugins))


@pytest.mark.usefixtures("installed")
def test_the_command_line_sees_it(evlcp, tmp_path):
    assert json.loads(evlcp("info", "cam:0", "--json").out)["counts"]["events"] == 50
    assert evlcp("receive", "cam:0", "-o", tmp_path / "out").code == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["recording"]["format"] == "CAMERA"
    assert summary["recording"]["counts"]["events"] == 50


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    ("file", "url"),
    [
        *(("a.raw", url) for url in ("a.raw", "file:a.raw", "file:{}/a.raw", "file://{}/a.raw")),
        *(("run:7.raw", "run:7.raw"), ("-", "file:-"), ("camera:", "file:camera:"), ("tcp:x", "file:tcp:x")),
    ],
)
def test_names_of_files(file, url, tmp_path, monkeypatch):
    """What plugins leave goes to the readers; after `file:` stands a file's name, whatever it looks like."""
    monkeypatch.chdir(tmp_path)
    write_events(tmp_path / "first.raw", EVENTS, 1280, 720)
    (tmp_path / "first.raw").rename(tmp_path / file)
    assert len(read_events(url.format(tmp_path))) == 50


def test_an_unknown_scheme_is_one_line(evlcp):
    done = evlcp("info", "cam:0")
    assert done.code == 3
    assert done.err.startswith("evlcp: cam:0: scheme 'cam', expected file:, replay:, ")
    assert "or one that a plugin opens (asked: " in done.err
    assert len(done.err.splitlines()) == 1
    with pytest.raises(InputError, match=r"asked: Camera"):
        open_source("other:0", Registry.load(Camera()))


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    ("url", "reason"),
    [
        ("cam:broken", "evlcp_open_events('cam:broken') fails: KeyError: 'no such device'"),
        ("cam:file", "evlcp_open_events('cam:file') gave PosixPath, expected an EventSource"),
    ],
)
def test_a_plugin_that_fails_is_named(url, reason, evlcp):
    with pytest.warns(PluginWarning, match=re.escape(reason)), pytest.raises(InputError) as fault:
        open_source(url)
    assert str(fault.value).startswith(f"{url}: scheme 'cam', expected file:")
    assert str(fault.value).endswith(f"is broken and left out: {reason}")
    done = evlcp("info", url)
    assert done.code == 3
    assert reason in done.err
    assert "Traceback" not in done.err


def test_what_is_a_recording_waits_for_its_reader(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "0").touch()
    for name in ("a.raw", "file:a.raw", "replay:a.raw", "list:a.csv?unit=ms", "bag:none.mcap", "HDF5:a"):
        assert is_recording(name), name
    for name in ("-", "camera:", "cam:0", "tcp://127.0.0.1:1", "unix:0"):
        assert not is_recording(name), name


def test_a_strangers_plugin_comes_before_the_formats_of_ours(tmp_path):
    (tmp_path / "x.dat").write_bytes(bytes(64))
    with open_source(tmp_path / "x.dat", Registry.load(Camera())) as source:
        assert isinstance(source, CameraSource)


@pytest.mark.parametrize(
    ("suffix", "reason"),
    [("bad", "fails: KeyError: 'no room'"), ("odd", "gave Events, expected an EventWriter")],
)
def test_a_writer_that_cannot_be_used_is_named(tmp_path, suffix, reason):
    registry = Registry.load(Camera())
    with (
        pytest.warns(PluginWarning, match=re.escape(reason)),
        pytest.raises(ConfigError, match=f"suffix '.{suffix}', expected"),
    ):
        open_writer(tmp_path / f"a.{suffix}", 8, 8, registry=registry)


class BrokenWriter(EventWriter):
    """A writer of a stranger's package that fails at the file's end."""

    def _write(self, events, triggers):
        self._file.write(b"x")

    def _finish(self):
        raise KeyError("room")


def test_a_writer_that_fails_is_named_and_leaves_no_file(tmp_path):
    with (
        pytest.raises(
            PluginError, match=r"a\.dump: writer BrokenWriter: KeyError: 'room' \(test_open\.py, line"
        ),
        BrokenWriter(tmp_path / "a.dump", None, None) as writer,
    ):
        writer.write(EVENTS)
    assert not list(tmp_path.iterdir())
