"""Opening: plugins first, then the readers; a scheme that nobody knows is named."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evlcp_sdk.errors import InputError, PluginWarning
from evlcp_sdk.io import EventSource, open_source, read_events, write_events
from evlcp_sdk.plugin.hooks import hookimpl
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.values import Events, Triggers

EVENTS = Events.of(np.arange(50) * 10, np.arange(50), np.arange(50), np.ones(50))


class CameraSource(EventSource):
    """A camera of a stranger's package: fifty events, then it is unplugged."""

    def __init__(self) -> None:
        super().__init__(Path("cam:0"), "CAMERA", 1280, 720)
        self.left = [(EVENTS, Triggers.empty())]
        self.closed = False

    def take(self, max_events: int) -> tuple[Events, Triggers] | None:
        return self.left.pop() if self.left else None

    def close(self) -> None:
        self.closed = True


class Camera:
    @hookimpl
    def evlcp_open_events(self, url: str) -> Any:
        if url == "cam:broken":
            raise KeyError("no such device")
        if url == "cam:file":
            return Path("a.raw")
        return CameraSource() if url.startswith("cam:") else None


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The camera's plugin, as if its package were installed."""
    load = Registry.load
    monkeypatch.setattr(Registry, "load", lambda *plugins: load(Camera(), *plugins))


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "a.raw"
    write_events(path, EVENTS, 1280, 720)
    return path


@pytest.mark.usefixtures("installed")
def test_the_command_line_sees_it(evlcp: Callable[..., Any], tmp_path: Path) -> None:
    done = evlcp("info", "cam:0", "--json")
    assert done.code == 0
    assert json.loads(done.out)["counts"]["events"] == 50
    assert evlcp("receive", "cam:0", "-o", tmp_path / "out").code == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["recording"]["format"] == "CAMERA"
    assert summary["recording"]["counts"]["events"] == 50


@pytest.mark.usefixtures("installed")
def test_what_the_plugin_leaves_goes_to_the_readers(recording: Path) -> None:
    assert len(read_events(recording)) == 50
    assert len(read_events(f"file:{recording}")) == 50
    assert len(read_events(recording.as_uri())) == 50


def test_an_unknown_scheme_is_one_line(evlcp: Callable[..., Any]) -> None:
    done = evlcp("info", "cam:0")
    assert done.code == 3
    assert done.err.startswith("evlcp: cam:0: scheme 'cam', expected file:, replay:, ")
    assert "or one that a plugin opens (asked: " in done.err
    assert len(done.err.splitlines()) == 1
    with pytest.raises(InputError, match=r"asked: Camera"):
        open_source("other:0", Registry.load(Camera()))


def test_a_file_with_a_colon_in_its_name(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(recording.parent)
    recording.rename("run:7.raw")
    assert len(read_events("run:7.raw")) == 50


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    ("url", "reason"),
    [
        ("cam:broken", "evlcp_open_events('cam:broken') fails: KeyError: 'no such device'"),
        ("cam:file", "evlcp_open_events('cam:file') gave PosixPath, expected an EventSource"),
    ],
)
def test_a_plugin_that_fails_is_named(url: str, reason: str, evlcp: Callable[..., Any]) -> None:
    with pytest.warns(PluginWarning, match=re.escape(reason)), pytest.raises(InputError) as fault:
        open_source(url)
    assert str(fault.value).startswith(f"{url}: scheme 'cam', expected file:")
    assert str(fault.value).endswith(f"is broken and left out: {reason}")
    done = evlcp("info", url)
    assert done.code == 3
    assert reason in done.err
    assert "Traceback" not in done.err


def test_a_camera_that_is_not_there_says_so() -> None:
    class Unplugged:
        @hookimpl
        def evlcp_open_events(self, url: str) -> Any:
            raise InputError(f"{url}: no camera is plugged in")

    with pytest.raises(InputError, match=r"^cam:0: no camera is plugged in$"):
        open_source("cam:0", Registry.load(Unplugged()))
