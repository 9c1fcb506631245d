"""The folder of a result: a run's files come into place together, or not at all."""

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Any, BinaryIO, Self, TextIO

from evlcp_sdk.errors import ConfigError, EvlcpError
from evlcp_sdk.files import hidden_path
from evlcp_sdk.plugin.records import SUMMARY

__all__ = ["ResultFolder"]


class ResultFolder:
    """Files under hidden names beside the final ones, which `finish` moves into place; a context manager.

    Until then, and after a crash, an earlier result stays as it was.

    Args:
        folder: Made if need be.
        files: Names of all files that a run may leave; those that this one does not write are dropped in
            the end.

    Raises:
        ConfigError: The folder cannot be written.
    """

    def __init__(self, folder: Path, files: Iterable[str]) -> None:
        self.folder = folder
        self._files = tuple(dict.fromkeys((*files, SUMMARY)))
        self._used: list[str] = []
        self._open: list[IO[Any]] = []
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as fault:
            raise ConfigError(f"{folder}: cannot be written: {fault.strerror}") from fault

    def path(self, name: str) -> Path:
        """The hidden path of a file.

        Raises:
            ValueError: It is not among the files that a run may leave.
        """
        if name not in self._files:
            raise ValueError(f"'{name}' is not among the files of its record")
        if name not in self._used:
            self._used.append(name)
        return hidden_path(self.folder, name)

    def open(self, name: str) -> TextIO:
        """A text file, UTF-8, line ends as written; it is closed with the folder.

        Raises:
            ValueError: It is not among the files that a run may leave.
            OSError: It cannot be written.
        """
        file = self.path(name).open("w", encoding="utf-8", newline="")
        self._open.append(file)
        return file

    def open_binary(self, name: str) -> BinaryIO:
        """A binary file; it is closed with the folder.

        Raises:
            ValueError: It is not among the files that a run may leave.
            OSError: It cannot be written.
        """
        file = self.path(name).open("wb")
        self._open.append(file)
        return file

    def finish(self) -> None:
        """Move all files into place and drop what an earlier run left.

        The summary comes last: where it is, the result is complete.

        Raises:
            EvlcpError: A file cannot be written, e.g. the disk is full.
        """
        try:
            self._close()
            for name in sorted(self._files, key=lambda name: name == SUMMARY):
                hidden = hidden_path(self.folder, name)
                if name in self._used and hidden.exists():
                    hidden.replace(self.folder / name)
                else:
                    (self.folder / name).unlink(missing_ok=True)
        except OSError as fault:
            raise EvlcpError(f"{self.folder}: cannot be written: {fault.strerror}") from fault

    def _close(self) -> None:
        for file in self._open:
            file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Drop what `finish` has not moved into place."""
        for file in self._open:
            # A file that could not be written cannot be flushed either, and is dropped.
            with suppress(OSError):
                file.close()
        for name in self._used:
            hidden_path(self.folder, name).unlink(missing_ok=True)
