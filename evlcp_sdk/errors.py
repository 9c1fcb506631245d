"""The exceptions of the SDK; each carries the exit code the command line ends with.

```
EvlcpError                     1   anything the SDK raises on purpose
├── ConfigError                2   a configuration value; names its path, the value, what was expected
│   └── UnknownAlgorithmError  2   no algorithm of that role and id; suggests the nearest
├── PluginError                2   a plugin whose algorithm cannot be used or fails, or two of one (role, id)
├── OutputError                1   a file or folder that cannot be written
├── InputError                 3   a file or stream that cannot be read
│   ├── RawFormatError         3   a RAW file's header or words; names byte offset, found, expected
│   └── UnpluggedError         5   a camera that went away while it was read
├── InterruptedRunError      130   the user stopped the run; it says what was kept
├── WorkerError                1   a process that decodes for a receiver ended, or does not answer
└── StreamError                1   events fed in an order or shape the receiver cannot take
```

A recording of which much was dropped is no error, but ends a command with `DEGRADED`, 4. `PluginWarning`
warns of a broken plugin that is left out.
"""

import traceback
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar

from evlcp_sdk.formatting import format_safely, shorten


class EvlcpError(Exception):
    """Anything the SDK raises on purpose; the message is one line a user can act on."""

    exit_code: ClassVar[int] = 1


class ConfigError(EvlcpError):
    """A configuration value that cannot be used."""

    exit_code = 2


class UnknownAlgorithmError(ConfigError):
    """No algorithm with that role and id is installed."""


class PluginError(EvlcpError):
    """An algorithm of a broken plugin, one whose code fails, or one of two with the same role and id."""

    exit_code = 2


class PluginWarning(UserWarning):
    """A plugin is broken and left out."""


class OutputError(EvlcpError):
    """A file or folder that cannot be written: no room, no permission, or something else in its place."""


class InputError(EvlcpError):
    """A file or stream that cannot be read."""

    exit_code = 3


class RawFormatError(InputError):
    """A RAW file whose header or words are not what they should be.

    Args:
        path: The file.
        offset: Byte offset of the fault, counted from the start of the file.
        found: What is there.
        expected: What should be there.
    """

    def __init__(self, path: Path | str, offset: int, found: str, expected: str) -> None:
        self.path = Path(path)
        self.offset = offset
        self.found = found
        self.expected = expected
        super().__init__(f"{path}: at byte {offset}: found {found}, expected {expected}")


class UnpluggedError(InputError):
    """A camera that was unplugged while it was read; what was received until then is kept."""

    exit_code = 5


class WorkerError(EvlcpError):
    """A process that decodes for a receiver ended, or does not answer."""


class StreamError(EvlcpError):
    """Events in an order or shape the receiver cannot take."""


class InterruptedRunError(EvlcpError):
    """The user stopped the run; what was done until then is kept, or the message says that nothing is."""

    exit_code = 130


@contextmanager
def name_place(place: str, kind: type[EvlcpError] = ConfigError) -> Iterator[None]:
    """Turn a `ConfigError` or `InputError` within into one of a kind, with its place before each line."""
    try:
        yield
    except (ConfigError, InputError) as fault:
        raise kind("\n".join(f"{place}{line}" for line in str(fault).splitlines())) from fault


def import_extra(module: str, extra: str, needed_by: str = "", error: type[EvlcpError] = ConfigError) -> Any:
    """Import a module of a package that comes with an extra.

    Raises:
        EvlcpError: It is not installed; the `error` names what it is `needed_by`, if that is given.
    """
    try:
        return import_module(module)
    except ImportError as fault:
        package, start = module.partition(".")[0], f"{needed_by}: " if needed_by else ""
        raise error(
            f"{start}{package} is not installed; it comes with the extra: pip install 'evlcp-sdk[{extra}]'"
        ) from fault


DEGRADED = 4
"""Exit code where a recording was decoded and much of it dropped."""

OWN_FAULT = 70
"""Exit code of a fault of the SDK itself."""

_FAILURE = 1
_MAX_PLACES = 12


def explain_fault(fault: BaseException) -> tuple[str, int]:
    """The message about an exception, and the exit code; a fault of the SDK itself gives a line to report."""
    if isinstance(fault, EvlcpError):
        return str(fault), fault.exit_code
    if isinstance(fault, MemoryError):
        return f"not enough memory: {short_message(fault)}", _FAILURE
    if isinstance(fault, OSError) and fault.filename is not None:
        return f"{fault.filename}: {fault.strerror}", _FAILURE
    return _report_line(fault), OWN_FAULT


def describe_plugin_fault(fault: BaseException) -> str:
    """What code of a plugin raised, in one line, with the file and line, unless these are the SDK's."""
    last = traceback.extract_tb(fault.__traceback__)[-1]
    line, file = f"{type(fault).__name__}: {format_safely(str, fault)}".splitlines()[0], Path(last.filename)
    is_own = file.is_relative_to(Path(__file__).parent)
    return line if is_own else f"{line} ({file.name}, line {last.lineno})"


@contextmanager
def blame(who: str, hint: str = "") -> Iterator[None]:
    """Turn what code of a plugin raises within into a `PluginError` that names it; the SDK's errors pass."""
    try:
        yield
    except EvlcpError:
        raise
    except (Exception, SystemExit) as fault:
        raise PluginError(f"{who}: {describe_plugin_fault(fault)}{hint}") from fault


def blame_class(one: object, what: str) -> AbstractContextManager[None]:
    """`blame` by the class of an object; what one of the SDK's own raises passes."""
    kind = type(one)
    is_own = kind.__module__.startswith("evlcp_sdk.")
    return nullcontext() if is_own else blame(f"{what} {kind.__name__}")


def fault_message(fault: BaseException) -> str:
    """The message of an exception in one line; its type where it has none."""
    return " ".join(str(fault).split()) or type(fault).__name__


def short_message(fault: BaseException) -> str:
    """The message of an exception in one line, its beginning where that is long."""
    return shorten(fault_message(fault), 200)


def _report_line(fault: BaseException) -> str:
    import platform
    from importlib.metadata import version

    def place(frame: traceback.FrameSummary) -> str:
        return f"{'/'.join(Path(frame.filename).parts[-2:])}:{frame.lineno}"

    frames = traceback.extract_tb(fault.__traceback__)[-_MAX_PLACES:]
    return (
        f"a fault of evlcp itself, not of what you gave: {type(fault).__name__}: {short_message(fault)};"
        " please report the command, what it was given, and this line:"
        f" evlcp-sdk {version('evlcp-sdk')}, Python {platform.python_version()}, {platform.platform()},"
        f" at {' > '.join(map(place, frames))}"
    )
