"""The folder of a result: a run's files come into place together, or not at all."""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, Self, TextIO

from evlcp_sdk.errors import InputError
from evlcp_sdk.files import Outputs, check_output, check_sha256, read_json, writing
from evlcp_sdk.plugin.records import SUMMARY


class ResultFolder:
    """Files in a hidden folder that `finish` moves into the result's; a context manager.

    Until then, and after a crash, an earlier result stays as it was.

    Args:
        folder: Created if need be.
        files: Names of all files that a run may leave; `finish` removes those that this one does not write.

    Raises:
        OutputError: The folder cannot be written, or one of these names is no regular file.
    """

    def __init__(self, folder: Path, files: Iterable[str]) -> None:
        self.folder = folder
        self._files = tuple(dict.fromkeys((*files, SUMMARY)))
        self._used: set[str] = set()
        self._opened: set[str] = set()
        self._outputs = Outputs()
        self._created = not folder.exists()
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
        for name in self._files:
            check_output(folder / name)

    def path(self, name: str) -> Path:
        """Where to write a file until the run ends; nothing is there yet.

        Raises:
            ValueError: It is not among the files that a run may leave.
            OutputError: It cannot be written.
        """
        return self._outputs.path(self._claim(name))

    def open(self, name: str) -> TextIO:
        """Open a text file, UTF-8, line ends as written; it is closed with the folder.

        Raises:
            ValueError: It is not among the files that a run may leave, or was opened before.
            OutputError: It cannot be written.
        """
        return self._outputs.open(self._claim(name, opened=True))

    def open_binary(self, name: str) -> BinaryIO:
        """Open a binary file; else like `open`."""
        return self._outputs.open_binary(self._claim(name, opened=True))

    def _claim(self, name: str, *, opened: bool = False) -> Path:
        if name not in self._files:
            raise ValueError(f"'{name}' is not among the files of its record")
        if opened and name in self._opened:
            raise ValueError(f"'{name}' was opened before")
        self._used.add(name)
        self._opened |= {name} if opened else set()
        return self.folder / name

    def digests(self) -> dict[str, dict[str, Any]]:
        """Close the files; size in bytes and SHA-256 of each, by name.

        Raises:
            OutputError: A file cannot be written, e.g. the disk is full.
        """
        with writing(self.folder):
            return self._outputs.digests()

    def finish(self) -> None:
        """Move all files into place, the last one that was opened last, and remove old ones.

        Raises:
            OutputError: A file cannot be written, e.g. the disk is full.
        """
        for name in self._files:
            if name not in self._used:
                self._outputs.drop(self.folder / name)
        self._outputs.commit()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_fault: object) -> None:
        """Drop what `finish` has not moved into place, and the folder if it was created and is empty."""
        self._outputs.discard()
        if self._created:
            with suppress(OSError):  # It has a result.
                self.folder.rmdir()


def read_summary(folder: Path | str) -> dict[str, Any] | None:
    """Read a result's `summary.json`; None where there is none.

    Raises:
        InputError: It cannot be read, is no object, or marks the files as unfinished.
    """
    path = Path(folder) / SUMMARY
    if not path.exists():
        return None
    table = read_json(path)
    if not isinstance(table, dict):
        raise InputError(f"{path}: expected an object")
    return table


def check_result_file(folder: Path | str, name: str, summary: Mapping[str, Any]) -> None:
    """Check that the file of this name in a result is the one that its summary lists.

    Raises:
        InputError: The summary does not list it, or it is another file.
    """
    path = Path(folder) / SUMMARY
    files = summary.get("files")
    entry = files.get(name) if isinstance(files, dict) else None
    digest = entry.get("sha256") if isinstance(entry, dict) else None
    if not isinstance(digest, str):
        raise InputError(f"{path}: files.{name}.sha256 = {digest!r:.40}: expected the file's SHA-256")
    check_sha256(Path(folder) / name, digest, SUMMARY)
