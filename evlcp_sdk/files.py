"""Files written so that no reader ever sees half a result; and small ones read whole.

The SDK writes all its results by `Outputs`: files grow in a private folder of random name beside their
targets and are moved into place together; links are neither followed nor replaced, nor are devices replaced;
and a run that dies while its files are moved leaves a mark that readers refuse.
"""

import csv
import difflib
import errno
import hashlib
import io
import json
import math
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, BinaryIO, Self, TextIO

from evlcp_sdk.errors import ConfigError, InputError, OutputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

_OTHERS_PERMISSIONS = 0o077
"""Those of group and others, which a private file does not have."""

STAGE_PREFIX = ".evlcp-"
"""Of the folders in which files grow; those that a killed run leaves may be deleted."""

_UNFINISHED = {
    "status": "unfinished",
    "error": "the run ended while its files came into place: those beside this one may belong to two runs",
}
"""Stands in for the last file, if it is JSON, while the others are moved into place."""


@contextmanager
def writing(path: Path | str) -> Iterator[None]:
    """Turn an `OSError` within into an `OutputError` that names the file or folder."""
    try:
        yield
    except OSError as fault:
        raise OutputError(f"{path}: cannot be written: {fault.strerror or fault}") from fault


@contextmanager
def _reading(path: Path | str) -> Iterator[None]:
    """Turn an `OSError` within into an `InputError` that names the file."""
    try:
        yield
    except OSError as fault:
        raise InputError(f"{path}: cannot be read: {fault.strerror or fault}") from fault


class Outputs:
    """Files that come into place together, or not at all; a context manager whose end is `commit`.

    Until then, and after a crash, earlier files stay. The file that was asked for last is the seal: while the
    others are moved into place it is missing, or, if it is JSON, says that the files are unfinished, which
    `read_json` refuses. So whoever finds it finds all of them. What is no regular file (a pipe, `/dev/null`)
    is written directly.
    """

    def __init__(self) -> None:
        self._stages: dict[Path, Path] = {}
        self._staged: dict[Path, Path] = {}
        self._dropped: list[Path] = []
        self._open: list[tuple[Path, IO[Any]]] = []

    def path(self, target: Path) -> Path:
        """Where to write a file that `commit` moves to `target`; nothing is there yet.

        Raises:
            OutputError: The folder is missing or cannot be written, or a link or a folder is in the way.
        """
        if target in self._staged:
            return self._staged[target]
        with writing(target):
            if _is_special(target):
                return target
            if target.parent not in self._stages:
                self._stages[target.parent] = Path(tempfile.mkdtemp(prefix=STAGE_PREFIX, dir=target.parent))
        self._staged[target] = self._stages[target.parent] / target.name
        return self._staged[target]

    def open(self, target: Path) -> TextIO:
        """Open a text file, UTF-8, line ends as written; it is closed with the others.

        Raises:
            OutputError: As `path`.
            OSError: It cannot be opened.
        """
        return self._open_file(target, "", encoding="utf-8", newline="")  # type: ignore[return-value]

    def open_binary(self, target: Path) -> BinaryIO:
        """Open a binary file; as `open`."""
        return self._open_file(target, "b")  # type: ignore[return-value]

    def _open_file(self, target: Path, kind: str, **text: str) -> IO[Any]:
        path = self.path(target)
        file: IO[Any] = path.open(f"{'w' if path == target else 'x'}{kind}", **text)  # type: ignore[call-overload]
        self._open.append((target, file))
        return file

    def write_text(self, text: str, target: Path) -> None:
        """Write a text file.

        Raises:
            OutputError: It cannot be written.
        """
        with writing(target), self.open(target) as file:
            file.write(text)

    def write_bytes(self, data: bytes, target: Path) -> None:
        """Write a binary file.

        Raises:
            OutputError: It cannot be written.
        """
        with writing(target), self.open_binary(target) as file:
            file.write(data)

    def write_array(self, array: "NDArray[Any]", target: Path) -> None:
        """Write an array as `.npy` under exactly this name.

        Raises:
            OutputError: It cannot be written.
        """
        import numpy as np

        # NumPy bypasses Python when it writes to a file, which fails on a pipe.
        buffer = io.BytesIO()
        np.save(buffer, array)
        self.write_bytes(buffer.getvalue(), target)

    def drop(self, target: Path) -> None:
        """Remove a file of an earlier run when these come into place."""
        self._dropped.append(target)

    def digests(self) -> dict[str, dict[str, Any]]:
        """Close the open files; size and SHA-256 of each that was written, by its name.

        Raises:
            OSError: Something cannot be written or read back.
        """
        for _, file in self._open:
            file.close()
        digests = {}
        for target, staged in self._staged.items():
            if staged.exists():
                with staged.open("rb") as file:
                    digest = hashlib.file_digest(file, "sha256").hexdigest()
                digests[target.name] = {"bytes": staged.stat().st_size, "sha256": digest}
        return digests

    def commit(self) -> None:
        """Move all files into place, the seal last, and remove those to drop.

        Raises:
            OutputError: A file cannot be written; an earlier result stays, unless files were already moved.
        """
        for target, file in self._open:
            with writing(target):
                file.close()
        written = {target: staged for target, staged in self._staged.items() if staged.exists()}
        for target, staged in written.items():
            with writing(target):
                # Somebody may have put a link there meanwhile.
                _is_special(target)
                _sync(staged)
        obsolete = [*self._dropped, *(target for target in self._staged if target not in written)]
        obsolete = [target for target in obsolete if os.path.lexists(target)]
        seal = next(reversed(written), None)
        if seal is not None and (obsolete or len(written) > 1):
            with writing(seal):
                self._unseal(seal)
        for target in obsolete:
            with writing(target):
                target.unlink()
        for target, staged in written.items():
            with writing(target):
                if target == seal and len(written) > 1:
                    self._sync_folders()
                staged.replace(target)
        if seal is not None:
            with writing(seal):
                self._sync_folders()
        self.discard()

    def _unseal(self, seal: Path) -> None:
        """Remove the seal, or mark it as unfinished, while the files are those of two runs."""
        if seal.suffix == ".json":
            mark = self._stages[seal.parent] / f"{seal.name}.unfinished"
            with mark.open("x", encoding="utf-8") as file:
                json.dump(_UNFINISHED, file)
            _sync(mark)
            mark.replace(seal)
        else:
            seal.unlink(missing_ok=True)
        _sync(seal.parent)

    def _sync_folders(self) -> None:
        for folder in self._stages:
            _sync(folder)

    def discard(self) -> None:
        """Remove what has not come into place; what has is no longer this one's."""
        for _, file in self._open:
            # A file that could not be written cannot be flushed either.
            with suppress(OSError):
                file.close()
        for stage in self._stages.values():
            shutil.rmtree(stage, ignore_errors=True)
        self._stages, self._staged, self._dropped, self._open = {}, {}, [], []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, fault: type[BaseException] | None, *_more: object) -> None:
        try:
            if fault is None:
                self.commit()
        finally:
            self.discard()


def _is_special(path: Path) -> bool:
    """Whether a path can be written though it is no regular file: a pipe, a terminal, `/dev/null`.

    Raises:
        OutputError: It is a link to a file, a folder or a disk.
    """
    try:
        mode = own_mode = path.lstat().st_mode
    except FileNotFoundError:
        return False
    if stat.S_ISLNK(own_mode):
        # Such as /dev/stdout, and what a shell gives for >(command).
        with suppress(OSError):
            mode = path.stat().st_mode
    if stat.S_ISCHR(mode) or stat.S_ISFIFO(mode):
        return True
    if stat.S_ISLNK(own_mode):
        raise OutputError(
            f"{path}: cannot be written: it is a link; name the file itself, or remove the link"
        )
    if not stat.S_ISREG(own_mode):
        what = "Is a directory" if stat.S_ISDIR(own_mode) else "neither a file nor a pipe"
        raise OutputError(f"{path}: cannot be written: {what}")
    return False


def check_output(path: Path, *, regular: bool = True) -> None:
    """Check before the work that a file can be written here; a `regular` one is no pipe or terminal.

    Raises:
        OutputError: A link, a folder or a device is in its place.
    """
    with writing(path):
        special = _is_special(path)
    if special and regular:
        raise OutputError(f"{path}: cannot be written: not a regular file")


def _sync(path: Path) -> None:
    """Flush a file, or the names in a folder, to the disk."""
    number = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(number)
    except OSError as fault:
        # Some file systems flush their folders by themselves, and cannot be asked to.
        if not (path.is_dir() and fault.errno in (errno.EINVAL, errno.ENOTSUP)):
            raise
    finally:
        os.close(number)


def write_secret(data: bytes, path: Path) -> None:
    """Write a file that its owner alone can use; half a file does not stay.

    Raises:
        OutputError: It exists, or cannot be written.
    """
    if os.path.lexists(path):
        raise OutputError(f"{path}: exists; a key is not overwritten; --show prints it again")
    with writing(path):
        number = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        try:
            with os.fdopen(number, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(number)
            _sync(path.parent)
        except BaseException:
            path.unlink()
            raise


def read_secret(path: Path, max_bytes: int) -> bytes:
    """Read the first bytes of a file that its owner alone can use.

    Raises:
        InputError: It cannot be read, or others can use it.
    """
    with _reading(path), path.open("rb") as file:
        mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
        if mode & _OTHERS_PERMISSIONS:
            raise InputError(
                f"{path}: mode {mode:04o}, expected a private key that its owner alone can use: chmod 600"
            )
        return file.read(max_bytes)


def open_log(path: Path) -> TextIO:
    """Open a text file that is in place while it grows, to survive a crash; links are not followed.

    Raises:
        OutputError: The file cannot be written.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC
    with writing(path):
        flags |= 0 if _is_special(path) else os.O_NOFOLLOW
        return os.fdopen(os.open(path, flags, 0o666), "w", encoding="utf-8")


def escape_formula(text: str) -> str:
    """Prefix a CSV cell that a spreadsheet would take for a formula with `'`.

    >>> escape_formula("=1+1"), escape_formula("night.raw")
    ("'=1+1", 'night.raw')
    """
    return f"'{text}" if text[:1] in _FORMULA else text


_FORMULA = frozenset("=+-@\t\r\n\uff1d\uff0b\uff0d\uff20")


def check_sha256(path: Path, expected: str, source: str) -> None:
    """Check that a file is the one whose SHA-256, 64 hex digits, another file (`source`) gives.

    Raises:
        InputError: It cannot be read, or is another one.
    """
    with _reading(path), path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if digest != expected:
        raise InputError(
            f"{path}: not the file that {source} speaks of: SHA-256 {digest[:16]}, expected {expected[:16]};"
            " changed since, or of another run"
        )


def read_csv(path: Path | str) -> tuple[tuple[str, ...], list[tuple[int, dict[str, Any]]]]:
    """Read the columns of a CSV file and its rows of text, each with its line; empty lines give no row.

    Raises:
        InputError: The file cannot be read, or is not CSV.
        ConfigError: Two columns have one name, or a line has more or fewer fields than the first one.
    """
    try:
        # Spreadsheets start a file with a byte order mark.
        with _reading(path), Path(path).open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            rows = [(reader.line_num, row) for row in reader]
            names = tuple(reader.fieldnames or ())
    except (UnicodeDecodeError, csv.Error) as fault:
        raise InputError(f"{path}: not a CSV file: {fault}") from fault
    for name in filter(None, names):
        if names.count(name) > 1:
            raise ConfigError(f"{path}: line 1: {names.count(name)} columns {name}: expected one")
    for line, row in rows:
        surplus = len(row.get(None, ()))
        if surplus or None in row.values():
            fields = len(names) + surplus - list(row.values()).count(None)
            raise ConfigError(f"{path}: line {line}: {fields} fields, expected {len(names)}, as line 1 has")
    return names, rows


_UNITS = frozenset(
    ("deg", "rad", "mrad", "m", "mm", "cm", "km", "s", "ms", "us", "ns", "g", "m2", "s2", "m2s")
)
"""Words of a column's name that give its unit."""

_MIN_SIMILARITY = 0.85
"""Of two names, from which on one is a typing error of the other: a letter of four to eight."""


def check_columns(
    path: Path | str, names: Sequence[str], needed: Sequence[str], optional: Sequence[str] = ()
) -> None:
    """Check the columns of a CSV file; further ones are allowed if they resemble none that is missing.

    An optional column under a similar name (other unit, case, order of words, a typing error, another axis)
    would be lost silently.

    Raises:
        ConfigError: A needed one is missing, or one looks like another that is missing.
    """
    known = tuple(dict.fromkeys((*needed, *optional)))
    missing_words = {name: _split_words(name) for name in known if name not in names}
    first_words = [_split_words(name)[:1] for name in known]
    for name in names:
        if name in known or not name:
            continue
        words = _split_words(name)
        for expected, expected_words in missing_words.items():
            axes = words[:1] == expected_words[:1] and first_words.count(words[:1]) >= 3
            similarity = difflib.SequenceMatcher(None, "_".join(words), "_".join(expected_words)).ratio()
            if axes or similarity >= _MIN_SIMILARITY or sorted(words) == sorted(expected_words):
                raise ConfigError(f"{path}: line 1: column {name!r:.40}: expected {expected}")
    missing = [name for name in needed if name not in names]
    if missing:
        raise ConfigError(f"{path}: line 1: no column {missing[0]} (columns: {', '.join(known)})")


def _split_words(name: str) -> list[str]:
    return [word for word in re.split("[^a-z0-9]+", name.lower()) if word and word not in _UNITS]


_MAX_NUMBER = 1e18
"""Largest number in a CSV file: microseconds since 1970 are 1e15."""

ANY_NUMBER = (-math.inf, math.inf)


def parse_csv_number(
    path: Path | str, line: int, name: str, text: str | None, within: tuple[float, float] = ANY_NUMBER
) -> float:
    """Parse a number of a CSV file.

    Raises:
        ConfigError: It is no number, too large to make sense, or outside the range `within`.
    """
    try:
        value = float(text if text is not None else "")
    except ValueError:
        value = math.nan
    if not abs(value) <= _MAX_NUMBER:
        expected_text = "a number" if not math.isfinite(value) else f"at most {_MAX_NUMBER:g}"
        raise ConfigError(f"{path}: line {line}: {name} = {text!r:.40}: expected {expected_text}")
    low, high = within
    if not low <= value <= high:
        raise ConfigError(f"{path}: line {line}: {name} = {text!r:.40}: expected {low:g} to {high:g}")
    return value


def read_table(
    path: Path | str,
    needed: Mapping[str, tuple[float, float]],
    optional: Mapping[str, tuple[float, float]],
    rising: str = "",
) -> tuple[list[int], dict[str, "NDArray[Any]"]]:
    """Read the line of each row of a CSV file, and its columns of numbers, float64 (n,) each, n >= 1.

    `needed` and `optional` are columns with the range of their numbers; those of `rising` must rise from line
    to line, as times do.

    Raises:
        InputError: The file cannot be read, or is not CSV.
        ConfigError: A column is missing, there is no row, or a number is none, out of range or does not rise.
    """
    import numpy as np

    names, rows = read_csv(path)
    check_columns(path, names, tuple(needed), tuple(optional))
    if not rows:
        raise ConfigError(f"{path}: expected one line of values or more")
    table = {
        name: np.array([parse_csv_number(path, line, name, row[name], within) for line, row in rows])
        for name, within in {**needed, **optional}.items()
        if name in names
    }
    lines = [line for line, _ in rows]
    if rising:
        check_rising(path, lines, rising, table[rising])
    return lines, table


def check_rising(path: Path | str, lines: Sequence[int], name: str, values: "NDArray[Any]") -> None:
    """Check that the numbers of a column rise from line to line.

    Raises:
        ConfigError: One does not.
    """
    for i in range(1, len(values)):
        if values[i] <= values[i - 1]:
            raise ConfigError(
                f"{path}: line {lines[i]}: {name} = {values[i]:.16g}: expected more than the line before,"
                f" {values[i - 1]:.16g}: rising {name}"
            )


MAX_BYTES = 1 << 28
"""Larger files are not read whole."""


def read_bytes(path: Path | str) -> bytes:
    """Read a whole file.

    Raises:
        InputError: It cannot be read, or is too large, as an endless device.
    """
    with _reading(path), Path(path).open("rb") as file:
        data = file.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise OSError(errno.EFBIG, f"larger than {MAX_BYTES >> 20} MiB")
    return data


def read_npy(path: Path | str) -> "NDArray[Any]":
    """Read the array of numbers in a `.npy` file.

    Raises:
        InputError: The file cannot be read, or holds something else.
    """
    import numpy as np

    file = io.BytesIO(read_bytes(path))
    try:
        array: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    except Exception as fault:
        # NumPy evaluates the header as a piece of Python, which may fail in any way.
        reason = " ".join(str(fault).split())
        raise InputError(f"{path}: not a .npy file of plain numbers: {reason:.200}") from fault
    if array.dtype.kind not in "biuf":
        raise InputError(f"{path}: not a .npy file of plain numbers, but of {array.dtype}")
    return array


def read_json(path: Path | str) -> Any:
    """Read a JSON file.

    Raises:
        InputError: The file cannot be read, is not JSON, or is the mark that `Outputs` leaves of a run that
            died while its files were moved into place.
    """
    try:
        value = json.loads(read_bytes(path))
    except (ValueError, RecursionError) as fault:
        raise InputError(f"{path}: not JSON: {fault}") from fault
    if value == _UNFINISHED:
        raise InputError(f"{path}: unfinished: {value['error']}; write them again")
    return value


def find_shipped_file(folder: str, name: str) -> Path:
    """The path of a file that comes with the SDK: in the wheel, or in a checkout's `examples/`.

    Raises:
        FileNotFoundError: It is not there.
    """
    package = Path(__file__).parent
    for path in (package / "data" / name, package.parent / "examples" / folder / name):
        if path.exists():
            return path
    raise FileNotFoundError(f"{name}: missing from the installation")
