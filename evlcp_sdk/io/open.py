"""Open and save recordings of any format, and whatever plugins bring."""

import io
import math
import os
import re
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar
from urllib.parse import unquote

from evlcp_sdk.errors import ConfigError, EvlcpError, InputError
from evlcp_sdk.files import Outputs
from evlcp_sdk.io.raw import CODECS, RawSource, RawWriter
from evlcp_sdk.io.replay import LoopSource, ReplaySource
from evlcp_sdk.io.streams import SCHEMES, open_stream
from evlcp_sdk.io.tables import CsvWriter, NpzWriter
from evlcp_sdk.io.urls import parse_flag, parse_positive, split_options
from evlcp_sdk.lazy import LazyModule
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.plugin.writer import EventWriter
from evlcp_sdk.values import Events, Triggers

if TYPE_CHECKING:
    from evlcp_sdk.io import camera, lists
else:
    # Most runs need neither.
    camera, lists = (LazyModule(f"evlcp_sdk.io.{name}") for name in ("camera", "lists"))

T = TypeVar("T")

WRITABLE: Final = {".raw": "EVT3", ".npz": "NPZ", ".csv": "CSV", ".csv.gz": "CSV"}

STDIN: Final = "-"
"""Name of standard input."""

_RECORDING_SCHEMES: Final = ("", "file", "replay", "list", "bag", "hdf5")
"""Schemes of sources that wait for their reader; others that plugins open may be live."""

_SCHEME: Final = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):")


def _find_scheme(url: str) -> str:
    """Return the scheme before the `:` of a name, empty for a file or no scheme."""
    found = _SCHEME.match(url)
    return "" if found is None or os.path.lexists(url) else found[1].lower()


def is_recording(url: Path | str) -> bool:
    """Whether a name is that of a recording, by its scheme."""
    return str(url) != STDIN and _find_scheme(str(url)) in _RECORDING_SCHEMES


def open_source(url: Path | str, registry: Registry | None = None) -> EventSource:
    """Open a recording, a stream, a camera or what a plugin knows, as an event source: a context manager.

    Plugins are asked first, by the hook `evlcp_open_events`; one that fails is left out, with a
    `PluginWarning`. The format of a file is that of its content, or else of its suffix; `file:` may stand
    before its name.

    Args:
        url: A file, or what a plugin opens, e.g. `cam:0`; `-` for RAW words on standard input,
            `tcp://HOST:PORT`, `udp://HOST:PORT` or `unix:PATH` for those of another program;
            `replay:REC?speed=1&loop=1` for a recording at the speed of its own clock, in a loop;
            `camera:` for a camera by the extra `camera`.
        registry: The plugins to ask; None for all that are installed.

    Raises:
        InputError: It cannot be opened or is not of a known format, or its scheme is unknown.
    """
    registry = Registry.load() if registry is None else registry
    name = str(url)
    if _find_scheme(name) == "file":
        name = unquote(name.partition(":")[2].removeprefix("//"))
        if name == STDIN or _find_scheme(name):
            name = f"./{name}"  # a file's name, whatever it looks like
    source = _ask_plugins(registry, "evlcp_open_events", EventSource, url=name)  # type: ignore[type-abstract]
    if source is not None:
        return source
    if name == STDIN:
        return _open_stdin()
    scheme = _find_scheme(name)
    if not scheme:
        return _open_file(name)
    if scheme == "replay":
        return _open_replay(name, registry)
    if scheme in _OPENERS:
        return _OPENERS[scheme](name)
    asked = sorted(registry.plugins_with_hook("evlcp_open_events"))
    broken = "".join(f"; {plugin}" for plugin in registry.broken)
    raise InputError(
        f"{url}: scheme '{scheme}', expected {', '.join(f'{one}:' for one in ('file', 'replay', *_OPENERS))}"
        " or one that a plugin opens"
        f" (asked: {', '.join(asked) or 'no plugin that opens sources is installed'}){broken}"
    )


_OPENERS: Final[dict[str, Callable[[str], EventSource]]] = {
    "list": lambda url: lists.open_list(url),
    "camera": lambda url: camera.open_camera(url),
    **dict.fromkeys(SCHEMES, open_stream),
}


def _ask_plugins(registry: Registry, hook: str, kind: type[T], **arguments: Any) -> T | None:
    """Return the first answer of a plugin's hook, or None; a plugin that fails is left out."""
    subject = str(next(iter(arguments.values())))
    for impl in reversed(getattr(registry.hook, hook).get_hookimpls()):
        try:
            answer: object = impl.function(*(arguments[name] for name in impl.argnames))
        except EvlcpError:
            raise
        except (Exception, SystemExit) as fault:
            what = " ".join(f"{type(fault).__name__}: {fault}".split())
            registry.leave_out(impl.plugin_name, f"{hook}({subject!r}) fails: {what}")
            continue
        if isinstance(answer, kind):
            return answer
        if answer is not None:
            what = f"gave {type(answer).__name__}, expected an {kind.__name__}"
            registry.leave_out(impl.plugin_name, f"{hook}({subject!r}) {what}")
    return None


def _open_stdin() -> EventSource:
    name = "standard input"
    try:
        file = io.FileIO(0, closefd=False)
    except OSError as error:
        raise InputError(f"{name}: {error.strerror}") from error
    if file.isatty():
        raise InputError(f"{name} is a terminal, expected a recording: evlcp receive - < REC.raw")
    return RawSource(name, file=file)


def _open_replay(url: str, registry: Registry) -> EventSource:
    """Open `replay:REC`, with `?speed=`, `loop=` and `for_s=`."""
    name, options = split_options(url, {"speed": parse_positive, "loop": parse_flag, "for_s": parse_positive})
    inner = name.partition(":")[2]
    if not inner or inner == STDIN:
        raise InputError(f"{url}: expected replay:REC, the name of a recording")

    def open_inner() -> EventSource:
        return open_source(inner, registry)

    for_s = options.get("for_s", math.inf)
    if for_s < math.inf and not options.get("loop"):
        raise InputError(f"{url}: for_s = {for_s:g}: only with loop=1")
    recording = LoopSource(open_inner, for_us=for_s * 1e6) if options.get("loop") else open_inner()
    if recording.live:
        recording.close()
        raise InputError(f"{url}: {inner} has a pace of its own, expected a recording")
    return ReplaySource(recording, options.get("speed", 1.0))


def _open_file(name: str) -> EventSource:
    """Open a RAW file, or a list of events, by its content or its name."""
    path = Path(name)
    suffix = _suffix(path)
    try:
        with path.open("rb") if path.is_file() else nullcontext() as file:
            start = b"" if file is None else file.read(4)
        is_raw = start.startswith(b"% ") and (suffix == ".raw" or suffix not in lists.SUFFIXES)
        is_zip = start.startswith((b"PK\x03\x04", b"\x1f\x8b"))
        has_suffix = suffix in (".csv", ".csv.gz", ".npz")
        if not is_raw and (is_zip or has_suffix or (start and lists.is_list(path))):
            return lists.open_list(path)
    except OSError as error:
        raise InputError(f"{name}: {error.strerror}") from error
    return RawSource(name)


def _suffix(path: Path) -> str:
    return "".join(path.suffixes[-2:]).lower() if path.suffix == ".gz" else path.suffix.lower()


def read_events(url: Path | str) -> Events:
    """Return all events of a recording; `open_source(url).read()` returns the triggers too.

    Raises:
        InputError: The recording cannot be read.
    """
    with open_source(url) as source:
        return source.read()[0]


def open_writer(
    path: Path | str,
    width: int | None = None,
    height: int | None = None,
    format: str | None = None,
    outputs: Outputs | None = None,
    registry: Registry | None = None,
) -> EventWriter:
    """Create a recording to write piece by piece, a context manager.

    Args:
        path: The file; its suffix is the format: `.raw`, `.mcap`, `.npz`, `.csv` or `.csv.gz`.
        width: Columns of the sensor; RAW and bags need it, tables do not.
        height: Rows of the sensor, likewise.
        format: `EVT3` (the default for `.raw`), `EVT2`, `EVT21`, `BAG` (of ROS 2, by the extra `ros`), `NPZ`
            or `CSV`, whatever the file's name.
        outputs: The files that appear together with it; None lets it appear as soon as it is closed.
        registry: The plugins to ask for other formats; None for all that are installed.

    Raises:
        ConfigError: The format is unknown, width and height are missing for RAW or a bag, or a package that a
            bag needs is not installed.
        OutputError: The file cannot be written.
    """
    suffix = _suffix(Path(path))
    name = (format or WRITABLE.get(suffix, "")).upper()
    if name == "NPZ":
        return NpzWriter(path, width, height, outputs)
    if name == "CSV":
        return CsvWriter(path, width, height, outputs)
    if name not in CODECS:
        arguments = {"path": Path(path), "width": width, "height": height, "format": format or ""}
        registry = Registry.load() if registry is None else registry
        writer = _ask_plugins(registry, "evlcp_open_writer", EventWriter, **arguments, outputs=outputs)  # type: ignore[type-abstract]
        if writer is not None:
            return writer
        found = f"format {format!r}" if format else f"suffix {suffix!r}"
        raise ConfigError(
            f"{path}: {found}, expected {', '.join(WRITABLE)} or format {', '.join(CODECS)}, NPZ, CSV, or one"
            " that a plugin writes, as .mcap"
        )
    return RawWriter(path, width, height, CODECS[name], outputs)


def write_events(
    path: Path | str,
    events: Events,
    width: int | None = None,
    height: int | None = None,
    triggers: Triggers | None = None,
    format: str | None = None,
) -> None:
    """Save events and triggers, sorted by time, as a recording; arguments as of `open_writer`.

    Raises:
        ConfigError: The format is unknown.
        OutputError: The file cannot be written.
        StreamError: The format has no place for a value or for triggers, or times run backward.
    """
    with open_writer(path, width, height, format) as writer:
        writer.write(events, triggers)
