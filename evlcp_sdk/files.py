"""Files written whole, so that no reader ever sees half a result; small ones read whole.

Whatever the SDK leaves behind goes through `Outputs`, whose rules are these: files grow in a private folder
of random name beside their places and come into place together; links are neither followed nor replaced,
nor are devices replaced; and a run that dies while its files come into place leaves a mark that readers
refuse.
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

_OTHERS = 0o077
"""Permissions that a private file does not give."""

STAGE_PREFIX = ".evlcp-"
"""How the name of a folder begins in which files grow; what a killed run leaves of it may be deleted."""

_UNFINISHED = {
    "status": "unfinished",
    "error": "the run ended while its files came into place: those beside this one may belong to two runs",
}
"""What stands in place of the last file, if it is JSON, while others come into place."""


@contextmanager
def writing(path: Path | str) -> Iterator[None]:
    """What the system refuses within becomes an `OutputError` that names the file or folder."""
    try:
        yield
    except OSError as fault:
        raise OutputError(f"{path}: cannot be written: {fault.strerror or fault}") from fault


@contextmanager
def _reading(path: Path | str) -> Iterator[None]:
    """What the system refuses within becomes an `InputError` that names the file."""
    try:
        yield
    except OSError as fault:
        raise InputError(f"{path}: cannot be read: {fault.strerror or fault}") from fault


class Outputs:
    """Files that come into place together, or not at all; a context manager that is ended by `commit`.

    Until then, and after a crash, what was there before stays. The file that was asked for last is the seal:
    while the others come into place it is away, or, if it is JSON, says that the files are unfinished,
    which `read_json` refuses. So who finds it finds all of them. What is no regular file (a pipe,
    `/dev/null`) is written directly.
    """

    def __init__(self) -> None:
        self._stages: dict[Path, Path] = {}
        self._staged: dict[Path, Path] = {}
        self._direct: list[Path] = []
        self._dropped: list[Path] = []
        self._open: list[IO[Any]] = []

    def path(self, target: Path) -> Path:
        """Where a file is to be written, which becomes `target` in the end; nothing is there yet.

        Raises:
            OutputError: There is no such folder, it cannot be written, or a link or a folder is in the place.
        """
        if target in self._staged:
            return self._staged[target]
        if target in self._direct:
            return target
        with writing(target):
            if _is_special(target):
                self._direct.append(target)
                return target
            if target.parent not in self._stages:
                stage = tempfile.mkdtemp(prefix=STAGE_PREFIX, dir=target.parent)
                self._stages[target.parent] = Path(stage)
        self._staged[target] = self._stages[target.parent] / target.name
        return self._staged[target]

    def open(self, target: Path) -> TextIO:
        """A text file, UTF-8, line ends as written; it is closed with the others.

        Raises:
            OutputError: As `path`.
            OSError: It cannot be opened.
        """
        return self._opened(target, "", encoding="utf-8", newline="")  # type: ignore[return-value]

    def open_binary(self, target: Path) -> BinaryIO:
        """A binary file; as `open`."""
        return self._opened(target, "b")  # type: ignore[return-value]

    def _opened(self, target: Path, kind: str, **text: str) -> IO[Any]:
        path = self.path(target)
        self._open.append(path.open(f"{'w' if target in self._direct else 'x'}{kind}", **text))  # type: ignore[call-overload]
        return self._open[-1]

    def write_text(self, text: str, target: Path) -> None:
        """Write a text file.

        Raises:
            OutputError: It cannot be written.
        """
        with writing(target), self.open(target) as file:
            file.write(text)

    def write_array(self, array: "NDArray[Any]", target: Path) -> None:
        """Write an array as `.npy` under exactly this name.

        Raises:
            OutputError: It cannot be written.
        """
        import numpy as np

        # To a file itself NumPy writes past Python, which a pipe cannot take.
        whole = io.BytesIO()
        np.save(whole, array)
        with writing(target), self.open_binary(target) as file:
            file.write(whole.getbuffer())

    def drop(self, target: Path) -> None:
        """Remove what is left of an earlier run when the files come into place."""
        self._dropped.append(target)

    def digests(self) -> dict[str, dict[str, Any]]:
        """Size and SHA-256 of each file that is written so far, by its name; closes those that `open` gave.

        Raises:
            OSError: Something cannot be written or read back.
        """
        for file in self._open:
            file.close()
        found = {}
        for target, staged in self._staged.items():
            if staged.exists():
                with staged.open("rb") as file:
                    digest = hashlib.file_digest(file, "sha256").hexdigest()
                found[target.name] = {"bytes": staged.stat().st_size, "sha256": digest}
        return found

    def commit(self) -> None:
        """Bring all files into place, the seal last, and drop what is to be dropped.

        Raises:
            OutputError: A file cannot be written; an earlier result stays, unless the fault came while files
                came into place.
        """
        with writing(next(iter((*self._staged, *self._direct)), Path())):
            for file in self._open:
                file.close()
        written = {target: staged for target, staged in self._staged.items() if staged.exists()}
        for target, staged in written.items():
            with writing(target):
                # Somebody may have put a link there meanwhile.
                _is_special(target)
                _sync(staged)
        gone = [*self._dropped, *(target for target in self._staged if target not in written)]
        gone = [target for target in gone if os.path.lexists(target)]
        seal = next(reversed(written), None)
        if seal is not None and (gone or len(written) > 1):
            with writing(seal):
                self._unseal(seal)
        for target in gone:
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
        """Take the seal's place while the files are those of two runs."""
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
        """Remove what has not come into place."""
        for file in self._open:
            # A file that could not be written cannot be flushed either, and is dropped.
            with suppress(OSError):
                file.close()
        for stage in self._stages.values():
            shutil.rmtree(stage, ignore_errors=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_fault: object) -> None:
        """Remove what `commit` has not brought into place."""
        self.discard()


def _is_special(path: Path) -> bool:
    """Whether something is no regular file but can be written: a pipe, a terminal, `/dev/null`.

    Raises:
        OutputError: It is a link to a file, a folder or a disk.
    """
    try:
        mode = found = path.lstat().st_mode
    except FileNotFoundError:
        return False
    if stat.S_ISLNK(found):
        # Such as /dev/stdout, and what a shell gives for >(command).
        with suppress(OSError):
            mode = path.stat().st_mode
    if stat.S_ISCHR(mode) or stat.S_ISFIFO(mode):
        return True
    if stat.S_ISLNK(found):
        raise OutputError(
            f"{path}: cannot be written: it is a link; name the file itself, or remove the link"
        )
    if not stat.S_ISREG(found):
        what = "Is a directory" if stat.S_ISDIR(found) else "neither a file nor a pipe"
        raise OutputError(f"{path}: cannot be written: {what}")
    return False


def check_output(path: Path, *, regular: bool = True) -> None:
    """See that something can be written here, before the work is done.

    Args:
        path: The file; it need not be there.
        regular: A pipe or a terminal will not do.

    Raises:
        OutputError: A link, a folder or a device is in its place.
    """
    with writing(path):
        special = _is_special(path)
    if special and regular:
        raise OutputError(f"{path}: cannot be written: not a regular file")


def _sync(path: Path) -> None:
    """Have the disk hold what was written of a file, or the names in a folder."""
    number = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(number)
    except OSError as fault:
        # Some file systems hold their folders without being asked, and cannot be.
        if not (path.is_dir() and fault.errno in (errno.EINVAL, errno.ENOTSUP)):
            raise
    finally:
        os.close(number)


def write_secret(data: bytes, path: Path) -> None:
    """Write a file that its owner alone can use; one that cannot be written whole does not stay.

    Raises:
        OutputError: Something is there, or it cannot be written.
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


def read_secret(path: Path, most_bytes: int) -> bytes:
    """The first bytes of a file that its owner alone can use.

    Raises:
        InputError: It cannot be read, or others can use it.
    """
    with _reading(path), path.open("rb") as file:
        mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
        if mode & _OTHERS:
            raise InputError(
                f"{path}: mode {mode:04o}, expected a private key that its owner alone can use: chmod 600"
            )
        return file.read(most_bytes)


def open_log(path: Path) -> TextIO:
    """A text file that is there while it grows, for what must outlast a crash; links are not followed.

    Raises:
        OutputError: The file cannot be written.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC
    with writing(path):
        flags |= 0 if _is_special(path) else os.O_NOFOLLOW
        return os.fdopen(os.open(path, flags, 0o666), "w", encoding="utf-8")


def defused(text: str) -> str:
    """Text for a cell of a CSV file: what a spreadsheet would take for a formula begins with `'`.

    >>> defused("=1+1"), defused("night.raw")
    ("'=1+1", 'night.raw')
    """
    return f"'{text}" if text[:1] in _FORMULA else text


_FORMULA = frozenset("=+-@\t\r\n\uff1d\uff0b\uff0d\uff20")


def check_sha256(path: Path, expected: str, source: str) -> None:
    """See that a file is the one that another file names.

    Args:
        path: The file.
        expected: SHA-256, 64 hex digits.
        source: Who says so, for the message.

    Raises:
        InputError: It cannot be read, or is another one.
    """
    with _reading(path), path.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if found != expected:
        raise InputError(
            f"{path}: not the file that {source} speaks of: SHA-256 {found[:16]}, expected {expected[:16]};"
            " changed since, or of another run"
        )


def read_csv(path: Path | str) -> tuple[tuple[str, ...], list[tuple[int, dict[str, Any]]]]:
    """The columns of a CSV file, and its rows of text by column, each with its line; empty lines give no row.

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
        beyond = len(row.get(None, ()))
        if beyond or None in row.values():
            fields = len(names) + beyond - list(row.values()).count(None)
            raise ConfigError(f"{path}: line {line}: {fields} fields, expected {len(names)}, as line 1 has")
    return names, rows


_UNITS = frozenset(
    ("deg", "rad", "mrad", "m", "mm", "cm", "km", "s", "ms", "us", "ns", "g", "m2", "s2", "m2s")
)
"""Words of a column's name that are its unit."""

_LIKE = 0.85
"""Share of letters in common by which one name is a slip of another: a letter of four to eight."""


def check_columns(
    path: Path | str, names: Sequence[str], needed: Sequence[str], optional: Sequence[str] = ()
) -> None:
    """Check the columns of a CSV file that was read; further ones of other names are anyone's.

    An optional column that is not there, beside one that looks like it (other unit, case, order of words, a
    slip, another axis of what comes by axes), would be lost in silence.

    Raises:
        ConfigError: A needed one is missing, or one looks like another that is missing.
    """
    known = (*needed, *optional)
    lacking = {name: _words(name) for name in known if name not in names}
    starts = [_words(name)[:1] for name in known]
    for name in names:
        if name in known or not name:
            continue
        words = _words(name)
        for meant, its in lacking.items():
            axes = words[:1] == its[:1] and starts.count(words[:1]) >= 3
            slip = difflib.SequenceMatcher(None, "_".join(words), "_".join(its)).ratio() >= _LIKE
            if axes or slip or sorted(words) == sorted(its):
                raise ConfigError(f"{path}: line 1: column {name!r:.40}: expected {meant}")
    missing = [name for name in needed if name not in names]
    if missing:
        raise ConfigError(f"{path}: line 1: no column {missing[0]} (columns: {', '.join(known)})")


def _words(name: str) -> list[str]:
    return [word for word in re.split("[^a-z0-9]+", name.lower()) if word and word not in _UNITS]


_MOST = 1e18
"""Size of the largest number of a CSV file: microseconds since 1970 are 1e15."""

ANY_NUMBER = (-math.inf, math.inf)


def csv_number(
    path: Path | str, line: int, name: str, text: str | None, within: tuple[float, float] = ANY_NUMBER
) -> float:
    """A number of a CSV file that was read.

    Raises:
        ConfigError: It is not one, larger than any that makes sense, or not between these two.
    """
    try:
        value = float(text if text is not None else "")
    except ValueError:
        value = math.nan
    if not abs(value) <= _MOST:
        wanted = "a number" if not math.isfinite(value) else f"at most {_MOST:g}"
        raise ConfigError(f"{path}: line {line}: {name} = {text!r:.40}: expected {wanted}")
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
    """The line of each row of a CSV file, and its columns of numbers, float64 (n,) each, n >= 1.

    Args:
        path: The file.
        needed: Columns that it must have, and between what their numbers are.
        optional: Those that it may have.
        rising: The column whose numbers must rise from line to line, as times do.

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
        name: np.array([csv_number(path, line, name, row[name], within) for line, row in rows])
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


def is_there(path: Path | str) -> bool:
    """Whether there is a file or a folder of that name; what cannot be a name is not there."""
    try:
        return Path(path).exists()
    except OSError:
        return False


MOST_BYTES = 1 << 28
"""Files of more bytes are not read whole."""


def read_whole(path: Path | str) -> bytes:
    """The bytes of a file.

    Raises:
        InputError: It cannot be read, or is too large to be read whole, as a device without end.
    """
    with _reading(path), Path(path).open("rb") as file:
        data = file.read(MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            raise OSError(errno.EFBIG, f"larger than {MOST_BYTES >> 20} MiB")
    return data


def read_numbers(path: Path | str) -> "NDArray[Any]":
    """The array of numbers that a `.npy` file holds.

    Raises:
        InputError: The file cannot be read, or holds something else.
    """
    import numpy as np

    data = read_whole(path)
    if not data.startswith(b"\x93NUMPY"):
        raise InputError(f"{path}: not a .npy file of plain numbers")
    try:
        array: NDArray[Any] = np.load(io.BytesIO(data), allow_pickle=False)
    except Exception as fault:
        # NumPy evaluates the header as a piece of Python, which may fail in any way.
        reason = " ".join(str(fault).split())
        raise InputError(f"{path}: not a .npy file of plain numbers: {reason:.200}") from fault
    if array.dtype.kind not in "biuf":
        raise InputError(f"{path}: not a .npy file of plain numbers, but of {array.dtype}")
    return array


def read_json(path: Path | str) -> Any:
    """What a JSON file holds.

    Raises:
        InputError: The file is what `Outputs` leaves of a run that died while its files came into place,
            cannot be read, or is not JSON.
    """
    try:
        value = json.loads(read_whole(path))
    except (ValueError, RecursionError) as fault:
        raise InputError(f"{path}: not JSON: {fault}") from fault
    if value == _UNFINISHED:
        raise InputError(f"{path}: unfinished: {value['error']}; write them again")
    return value


def shipped(folder: str, name: str) -> Path:
    """A file that comes with the SDK: in the wheel, or in a checkout's `examples/`.

    Raises:
        FileNotFoundError: It is not there.
    """
    package = Path(__file__).parent
    for path in (package / "data" / name, package.parent / "examples" / folder / name):
        if path.exists():
            return path
    raise FileNotFoundError(f"{name}: missing from the installation")
