"""Results as they come, in one SQLite file; whatever was put there survives the death of its writer.

The file is in WAL mode and every result is a transaction of its own, written through to the disk: a
campaign that is killed at any moment goes on where it was, and a report can be drawn while it runs. Results
are kept by task id, apart from the plan; a campaign that grows or shrinks finds those it shares with its
former self.
"""

import json
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from evlcp_sdk.errors import ConfigError, EvlcpError, InputError, OutputError
from evlcp_sdk.files import check_output
from evlcp_sdk.study.campaign.plan import Plan
from evlcp_sdk.study.tally import Statistics

__all__ = ["Store"]

SCHEMA = 2

_TABLES = """
CREATE TABLE IF NOT EXISTS plan (
    id INTEGER PRIMARY KEY CHECK (id = 1), name TEXT NOT NULL, body TEXT NOT NULL
);
CREATE TABLE IF NOT EXISTS result (
    task TEXT PRIMARY KEY, statistics TEXT NOT NULL, finished_at TEXT NOT NULL DEFAULT CURRENT_TIMESTAMP
) WITHOUT ROWID;
"""


class Store:
    """A results file; use as a context manager.

    Args:
        path: The file.
        create: Make it if it is missing; otherwise it is opened for reading only.

    Raises:
        InputError: It is missing, or no results file of this schema.
        OutputError: It cannot be written.
    """

    def __init__(self, path: Path, *, create: bool = False) -> None:
        self.path = path
        if not create and not path.is_file():
            raise InputError(f"{path}: no results file there")
        if create:
            check_output(path)
        try:
            # Readers need write access to the WAL's index beside the file, but write no table.
            self._base = sqlite3.connect(path, timeout=30, isolation_level=None)
            (version,) = self._base.execute("PRAGMA user_version").fetchone()
            tables = {name for (name,) in self._base.execute("SELECT name FROM sqlite_master")}
            if version not in (0, SCHEMA) or (version == 0 and (tables or not create)):
                raise InputError(
                    f"{path}: not a results file of this SDK (schema {version}, expected {SCHEMA})"
                )
            if create:
                self._base.execute("PRAGMA journal_mode = WAL")
                self._base.execute("PRAGMA synchronous = FULL")
                with self._writing():
                    self._base.executescript(_TABLES)
                    self._base.execute(f"PRAGMA user_version = {SCHEMA}")
        except sqlite3.DatabaseError as fault:
            self._close()
            if not isinstance(fault, sqlite3.OperationalError):
                raise _no_store(path, fault) from fault
            if create:
                raise OutputError(f"{path}: cannot be written: {fault}") from fault
            raise InputError(f"{path}: {fault}") from fault
        except EvlcpError:
            self._close()
            raise

    def _close(self) -> None:
        if hasattr(self, "_base"):
            self._base.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.DatabaseError as fault:
            raise OutputError(
                f"{self.path}: cannot be written: {fault}; what was finished is kept"
            ) from fault

    @contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.DatabaseError, ValueError, TypeError, KeyError, AttributeError) as fault:
            raise _no_store(self.path, fault) from fault

    def adopt(self, plan: Plan) -> None:
        """Take a campaign's plan; a later plan of the same campaign replaces it.

        Raises:
            ConfigError: The file holds another campaign.
            InputError: The file is damaged.
            OutputError: The file cannot be written.
        """
        with self._reading():
            row = self._base.execute("SELECT name FROM plan").fetchone()
        if row is not None and row[0] != plan.name:
            raise ConfigError(
                f"{self.path}: holds the campaign '{row[0]}', not '{plan.name}'; give another file"
            )
        with self._writing():
            body = json.dumps(plan.to_dict())
            self._base.execute("INSERT OR REPLACE INTO plan VALUES (1, ?, ?)", (plan.name, body))

    def plan(self) -> dict[str, Any]:
        """The plan as `Plan.to_dict` gave it.

        Raises:
            InputError: There is none, or the file is damaged.
        """
        with self._reading():
            row = self._base.execute("SELECT body FROM plan").fetchone()
            table: dict[str, Any] | None = None if row is None else json.loads(row[0])
        if table is None:
            raise InputError(f"{self.path}: no campaign has started in it")
        return table

    def put(self, results: list[tuple[str, Statistics]]) -> None:
        """Keep results of tasks, all or none; one that is there already stays.

        Raises:
            OutputError: The file cannot be written, e.g. the disk is full; what was kept before stays.
        """
        rows = [(task, json.dumps(statistics.to_dict(), sort_keys=True)) for task, statistics in results]
        with self._writing():
            self._base.execute("BEGIN IMMEDIATE")
            try:
                self._base.executemany("INSERT OR IGNORE INTO result (task, statistics) VALUES (?, ?)", rows)
                self._base.execute("COMMIT")
            except sqlite3.DatabaseError:
                if self._base.in_transaction:
                    self._base.execute("ROLLBACK")
                raise

    def results(self) -> dict[str, Statistics]:
        """Task id to statistics, of all that is kept.

        Raises:
            InputError: The file is damaged.
        """
        with self._reading():
            rows = self._base.execute("SELECT task, statistics FROM result")
            return {task: Statistics.from_dict(json.loads(text)) for task, text in rows}


def _no_store(path: Path, fault: Exception) -> InputError:
    return InputError(f"{path}: damaged, or no results file of evlcp sweep ({type(fault).__name__}: {fault})")
