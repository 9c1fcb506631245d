"""The public face: which names it has, that they are described, and that it imports nothing by itself."""

import inspect
import re
import subprocess
import sys
import textwrap
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import evlcp_sdk as evlcp
from evlcp_sdk import errors, values
from evlcp_sdk.cli import _sdk
from evlcp_sdk.plugin import roles
from firmware_host.commands import _host

FACE = Path(evlcp.__file__)

FACE_NAMES = """
    Algorithm Alternative Attitude AttitudeLog BarLayout BarSite Beacon BlockError CameraModel Code
    Codebook ConfigError Corrected Curvature Decode Decoding Deframer Detection Detector
    ErrorCorrection EventSource Events EvlcpError FailedBar Filter Fix Frame FrameView Framing GnssLog
    DecodedFrame InputError InterruptedRunError LedColumns LedGrid LedRing LedTable Link Loss Measure Message
    MessageKind Modulation OutputError Packet PacketFormat Pilots Place PluginError PluginWarning
    PositionPlan PresenceMap Range Ranging RawFormatError ReceivedMessage Receiver Reception Region
    Registry ReplaySource ResultFolder Run Separate Separation Settled SimulatedSource Sink SinkRecord
    SoftSymbols StreamError SyncLock Synchronization Synchronizer Tracker Tracking Triggers
    UnknownAlgorithmError UnpluggedError WorkerError compose diagnose frames_table hookimpl load_link
    load_sites open read_events receive receive_to_folder simulate write_events
"""
NAMES = FACE_NAMES.split()


def test_all_errors_and_roles_and_values_are_there() -> None:
    wanted = {
        name
        for module in (errors, roles, values)
        for name, found in vars(module).items()
        if inspect.isclass(found) and found.__module__ == module.__name__ and not name.startswith("_")
    }
    wanted -= {"Role"}
    assert len(wanted) > 40
    assert wanted <= set(NAMES)


def test_the_names_are_these_and_described() -> None:
    assert evlcp.__all__ == sorted(NAMES)
    assert set(NAMES) <= set(dir(evlcp))
    for name in NAMES:
        found = getattr(evlcp, name)
        doc = inspect.getdoc(found) or ""
        assert doc.strip(), name
        assert not doc.startswith(f"{name}("), f"{name} has no docstring but the one that dataclass makes"
        assert getattr(evlcp, name) is found


def imports_for_types(path: Path) -> tuple[str, dict[str, Any]]:
    """Text of the imports under TYPE_CHECKING, and what they give."""
    (text,) = re.findall(r"^if TYPE_CHECKING:\n((?: .*\n|\n)+)", path.read_text(), re.MULTILINE)
    seen: dict[str, Any] = {}
    exec(textwrap.dedent(text), seen)
    del seen["__builtins__"]
    return text, seen


@pytest.mark.parametrize("space", [_sdk, _host])
def test_commands_find_the_modules_that_type_checkers_see(space: ModuleType) -> None:
    _, seen = imports_for_types(Path(space.__file__ or ""))
    assert seen == {name: getattr(space, name) for name in seen}
    with pytest.raises(AttributeError, match="no module 'stor' is listed here"):
        space.stor


def test_what_type_checkers_see_is_what_is_found() -> None:
    """The imports under TYPE_CHECKING name the same objects."""
    text, seen = imports_for_types(FACE)
    assert "open = open_source" in text
    del seen["open_source"]
    assert seen == {name: getattr(evlcp, name) for name in NAMES}
    # Type checkers take what is named twice for a part of the face.
    for name, other in re.findall(r"(\w+) as (\w+)", text):
        assert name == other


def imported_modules(code: str) -> set[str]:
    """All modules that a fresh interpreter has after a statement."""
    command = [sys.executable, "-c", f"import sys\n{code}\nprint(*sys.modules)"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    return set(done.stdout.splitlines()[-1].split())


def test_importing_the_package_imports_nothing_else() -> None:
    more = imported_modules("import evlcp_sdk as evlcp; dir(evlcp)") - imported_modules("")
    assert more == {"evlcp_sdk"}


COMMAND = """
from evlcp_sdk.cli.main import main
sys.argv = ["evlcp", {!r}]
try: main()
except SystemExit as end: assert not end.code, end
"""
LIGHT = "numba scipy evlcp_sdk.rx evlcp_sdk.sim matplotlib"


@pytest.mark.parametrize(
    ("code", "heavy"),
    [
        *(
            (f"import evlcp_sdk as evlcp; evlcp.{name}", LIGHT)
            for name in ("load_link", "hookimpl", "Registry", "ConfigError")
        ),
        ("import evlcp_sdk.io", "numba scipy faery"),
        ("import evlcp_sdk.sim.truth", "numba scipy"),
        ("import evlcp_sdk.run", "scipy.ndimage scipy.special scipy.linalg scipy.optimize"),
        (COMMAND.format("--help"), "numpy numba scipy matplotlib"),
        (COMMAND.format("plugins"), "numpy numba scipy matplotlib llvmlite"),
    ],
)
def test_what_is_light_imports_nothing_heavy(code: str, heavy: str) -> None:
    assert not {*heavy.split()} & imported_modules(code)


def test_what_is_refused() -> None:
    for arguments, message in (
        ({}, "nothing to send: give a text, data or a beacon"),
        ({"text": "x", "repeat": 0}, "repeat = 0, expected 1 or more"),
        ({"text": "x", "key": "private.pem"}, "key signs a beacon, and user goes into that of a site"),
        ({"beacon": evlcp.Beacon(48.0, 11.0, 500.0, 0.0, 0.0, 1.0), "user": b"x"}, "key signs a beacon, and"),
    ):
        with pytest.raises(evlcp.ConfigError, match=message):
            evlcp.compose(**arguments)
    with pytest.raises(AttributeError, match="module 'evlcp_sdk' has no attribute 'recieve'"):
        evlcp.recieve  # type: ignore[attr-defined]
