"""Open and save recordings of any format, and whatever plugins bring."""

import io
import re
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import unquote

from evlcp_sdk.errors import EvlcpError, InputError, StreamError
from evlcp_sdk.files import Outputs, is_there
from evlcp_sdk.io.faery import FORMATS, FaerySource
from evlcp_sdk.io.raw import CODECS, RawSource, RawWriter
from evlcp_sdk.io.replay import LoopSource, ReplaySource
from evlcp_sdk.io.streams import SCHEMES, open_stream
from evlcp_sdk.io.tables import CsvWriter, NpzWriter
from evlcp_sdk.io.urls import flag, positive, split_options
from evlcp_sdk.io.writers import EventWriter
from evlcp_sdk.late import Late
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.values import Events, Triggers

if TYPE_CHECKING:
    from evlcp_sdk.io import bags, camera, hdf5, lists, ros
else:
    # What most runs do not read.
    _late = ("bags", "camera", "hdf5", "lists", "ros")
    bags, camera, hdf5, lists, ros = (Late(f"evlcp_sdk.io.{name}") for name in _late)

WRITABLE: Final = {".raw": "EVT3", ".mcap": "BAG", ".npz": "NPZ", ".csv": "CSV", ".csv.gz": "CSV"}

STDIN: Final = "-"
"""What is opened as standard input."""

_RECORDED: Final = ("file", "replay", "bag", "hdf5", "list")
OWN: Final = (*_RECORDED, "camera", *SCHEMES)
"""Schemes that are opened without a plugin."""

_SCHEME: Final = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):")


def is_recording(url: Path | str) -> bool:
    """Whether a name is that of a recording, by what stands before its `:`."""
    scheme = _SCHEME.match(str(url))
    recorded = scheme is not None and scheme[1].lower() in _RECORDED
    return str(url) != STDIN and (scheme is None or is_there(url) or recorded)


def open_source(url: Path | str, registry: Registry | None = None) -> EventSource:
    """Open a recording, a stream, a camera or what a plugin knows, as an event source: a context manager.

    Plugins are asked first, by the hook `evlcp_open_events`; one that fails is left out, with a
    `PluginWarning`. Of a file the content says the format, or else the suffix of its name; `file:` before its
    name does no harm.

    Args:
        url: A file, or what a plugin opens, e.g. `cam:0`; `-` for RAW words on standard input,
            `tcp://HOST:PORT`, `udp://HOST:PORT` or `unix:PATH` for those of another program;
            `replay:REC?speed=1&loop=1` for a recording at the pace of its own clock, again and again;
            `camera:` for a camera by the extra `camera`.
        registry: The plugins that are asked; None for all that are installed.

    Raises:
        InputError: It cannot be opened or is not of a known format, or nobody knows its scheme.
    """
    registry = Registry.load() if registry is None else registry
    source = _ask_plugins(str(url), registry)
    if source is not None:
        return source
    if str(url) == STDIN:
        return _open_stdin()
    scheme = _SCHEME.match(str(url))
    if scheme is None or is_there(url):
        return _open_file(url)
    if scheme[1].lower() == "file":
        return _open_file(unquote(str(url)[len(scheme[0]) :].removeprefix("//")))
    if scheme[1].lower() == "replay":
        return _open_replay(str(url), registry)
    if scheme[1].lower() == "bag":
        return bags.open_bag(str(url))
    if scheme[1].lower() == "hdf5":
        return hdf5.open_hdf5(str(url))
    if scheme[1].lower() == "list":
        return lists.open_list(str(url))
    if scheme[1].lower() == "camera":
        return camera.open_camera(str(url))
    if scheme[1].lower() in SCHEMES:
        return open_stream(str(url))
    asked = sorted(registry.plugins("evlcp_open_events"))
    broken = "".join(f"; {plugin}" for plugin in registry.broken)
    raise InputError(
        f"{url}: scheme '{scheme[1]}', expected {', '.join(f'{one}:' for one in OWN)}"
        " or one that a plugin opens"
        f" (asked: {', '.join(asked) or 'no plugin that opens sources is installed'}){broken}"
    )


def _ask_plugins(url: str, registry: Registry) -> EventSource | None:
    """The source that the first plugin gives; None where none knows the url. One that fails is left out."""
    for impl in reversed(registry.hook.evlcp_open_events.get_hookimpls()):
        try:
            source: object = impl.function(*(url for _ in impl.argnames))
        except EvlcpError:
            raise
        except (Exception, SystemExit) as fault:
            what = " ".join(f"{type(fault).__name__}: {fault}".split())
            registry.leave_out(impl.plugin_name, f"evlcp_open_events({url!r}) fails: {what}")
            continue
        if isinstance(source, EventSource):
            return source
        if source is not None:
            what = f"gave {type(source).__name__}, expected an EventSource"
            registry.leave_out(impl.plugin_name, f"evlcp_open_events({url!r}) {what}")
    return None


def _open_stdin() -> EventSource:
    """RAW words on standard input: a pipe, which is read once, or a file."""
    name = "standard input"
    try:
        file = io.FileIO(0, closefd=False)
    except OSError as error:
        raise InputError(f"{name}: {error.strerror}") from error
    if file.isatty():
        raise InputError(f"{name} is a terminal, expected a recording: evlcp receive - < REC.raw")
    return RawSource(name, file=file)


def _open_replay(url: str, registry: Registry) -> EventSource:
    """A recording at its own pace: `replay:REC`, with `?speed=`, `loop=` and `for_s=`."""
    name, options = split_options(url, {"speed": positive, "loop": flag, "for_s": positive})
    inner = name.partition(":")[2]
    if not inner or inner == STDIN:
        raise InputError(f"{url}: expected replay:REC, the name of a recording")

    def opened() -> EventSource:
        return open_source(inner, registry)

    for_s = options.get("for_s")
    again = (
        LoopSource(opened, for_us=None if for_s is None else for_s * 1e6) if options.get("loop") else opened()
    )
    if again.live:
        again.close()
        raise InputError(f"{url}: {inner} has a pace of its own, expected a recording")
    if for_s is not None and not options.get("loop"):
        again.close()
        raise InputError(f"{url}: for_s = {for_s:g}: only with loop=1")
    return ReplaySource(again, options.get("speed", 1.0))


def _open_file(path: Path | str) -> EventSource:
    target = Path(path)
    if target.suffix.lower() in FORMATS:
        return FaerySource(path)
    if target.is_dir() and bags.is_bag(target, b""):
        return bags.open_bag(target)
    try:
        special = target.exists() and not target.is_file() and not target.is_dir()
        start = b"% " if special else _first_bytes(target)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    return _open_kind(path, target, start, special=special)


def _open_kind(path: Path | str, target: Path, start: bytes, *, special: bool) -> EventSource:
    """Open a file by its first bytes and its name; `special` are pipes and the like."""
    suffix = _suffix(target)
    if start.startswith(b"% ") and suffix == ".raw":
        return RawSource(path)
    if bags.is_bag(target, start):
        return bags.open_bag(target)
    if start.startswith((hdf5.MAGIC, hdf5.MATLAB)):
        return hdf5.Hdf5Source(path)
    if start.startswith(b"% ") and suffix not in lists.SUFFIXES:
        return RawSource(path)
    if start.startswith(b"PK\x03\x04") or suffix == ".npz":
        return lists.ListSource(path)
    is_table = start.startswith(b"\x1f\x8b") or suffix in (".csv", ".csv.gz")
    if is_table or (start and not special and lists.is_list(target)):
        return lists.ListSource(path)
    return RawSource(path)  # which says what is wrong


def _first_bytes(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(16)


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
) -> EventWriter:
    """Create a recording to write piece by piece, a context manager.

    Args:
        path: The file; `.raw`, `.mcap`, `.npz`, `.csv` or `.csv.gz` decides the format.
        width: Columns of the sensor; RAW and bags need it, the tables do not.
        height: Rows of the sensor, likewise.
        format: `EVT3` (the default for `.raw`), `EVT2`, `BAG` (of ROS 2, by the extra `ros`), `NPZ` or `CSV`,
            whatever the file's name.
        outputs: The files that it comes into place with; None for alone, as soon as it is closed.

    Raises:
        ConfigError: A package that a bag needs is not installed.
        OutputError: The file cannot be written.
        StreamError: The format is unknown, or width and height are missing for RAW or a bag.
    """
    name = (format or WRITABLE.get(_suffix(Path(path)), "")).upper()
    if name == "NPZ":
        return NpzWriter(path, width, height, outputs)
    if name == "CSV":
        return CsvWriter(path, width, height, outputs)
    if name != "BAG" and name not in CODECS:
        found = f"format {format!r}" if format else f"suffix {_suffix(Path(path))!r}"
        raise StreamError(
            f"{path}: {found}, expected {', '.join(WRITABLE)} or format EVT2, EVT3, BAG, NPZ, CSV"
        )
    if width is None or height is None:
        raise StreamError(f"{path}: sensor of {width}x{height}, expected a width and a height for {name}")
    if name == "BAG":
        return ros.EventBagWriter(path, width, height, outputs)
    return RawWriter(path, width, height, CODECS[name], outputs)


def write_events(
    path: Path | str,
    events: Events,
    width: int | None = None,
    height: int | None = None,
    triggers: Triggers | None = None,
    format: str | None = None,
) -> None:
    """Save events and triggers, sorted by time, as a recording; arguments as for `open_writer`.

    Raises:
        OutputError: The file cannot be written.
        StreamError: The format is unknown or has no place for a value or for triggers, or times run backward.
    """
    with open_writer(path, width, height, format) as writer:
        writer.write(events, triggers)
