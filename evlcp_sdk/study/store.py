"""Results as they come, in one SQLite file; whatever was put there survives the death of its writer.

The file is in WAL mode and every result is a transaction of its own, written through to the disk: a
campaign that is killed at any moment goes on where it was, and a report can be drawn while it runs. Results
are kept by task id, apart from the plan; a campaign that grows or shrinks finds those it shares with its
former self.
"""

import json
import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Self
from urllib.parse import quote

from evlcp_sdk.errors import ConfigError, InputError, OutputError
from evlcp_sdk.files import check_output
from evlcp_sdk.study.plan import Plan, plan_from_dict
from evlcp_sdk.study.tally import Statistics

SCHEMA = 3

_TABLES = """
CREATE TABLE IF NOT EXISTS plan (
    id INTEGER PRIMARY KEY CHECK (id = 1), name TEXT NOT NULL, body TEXT NOT NULL
);
CREATE TABLE IF NOT EXISTS result (
    task TEXT PRIMARY KEY, statistics TEXT NOT NULL, finished_at TEXT NOT NULL DEFAULT CURRENT_TIMESTAMP
) WITHOUT ROWID;
"""


def _connect(path: Path, *, create: bool) -> sqlite3.Connection:
    """A connection that believes nothing of a file but its rows."""
    mode = "mode=rwc"
    if not create:
        wal = path.with_name(f"{path.name}-wal")
        # Where nobody writes, no file beside it is needed, so that the folder may be read-only, too.
        mode = "mode=ro" if wal.exists() and wal.stat().st_size else "mode=ro&immutable=1"
    url = f"file:{quote(str(path.absolute()))}?{mode}"
    base = sqlite3.connect(url, timeout=30, isolation_level=None, uri=True)
    base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MOST_BYTES)
    base.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
    return base


_MOST_BYTES = 1 << 28
"""Length of the longest text that is read or written: the plan of a million tasks has 70 MB."""


def _schema_of(base: sqlite3.Connection) -> set[tuple[str, ...]]:
    """Everything that a base consists of: (type, name, SQL) of each part, however it is spaced."""
    parts = base.execute("SELECT type, name, sql FROM sqlite_master")
    return {tuple(" ".join(str(text).split()) for text in part) for part in parts}


def _own_schema() -> set[tuple[str, ...]]:
    with closing(sqlite3.connect(":memory:")) as base:
        base.executescript(_TABLES)
        return _schema_of(base)


_SCHEMA = _own_schema()


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
        with ExitStack() as opened:
            try:
                self._base = opened.enter_context(closing(_connect(path, create=create)))
                self._check(create=create)
            except sqlite3.OperationalError as fault:
                if create:
                    raise OutputError(f"{path}: cannot be written: {fault}") from fault
                raise InputError(f"{path}: {fault}") from fault
            except (sqlite3.DatabaseError, UnicodeDecodeError) as fault:
                raise _no_store(path, fault) from fault
            opened.pop_all()

    def _check(self, *, create: bool) -> None:
        """Refuse what is not a results file; make the tables of a new one."""
        self._base.execute("PRAGMA trusted_schema = OFF")
        self._base.execute("PRAGMA cell_size_check = ON")
        if not create:
            self._base.execute("PRAGMA query_only = ON")
        (version,) = self._base.execute("PRAGMA user_version").fetchone()
        found = _schema_of(self._base)
        other = f"{self.path}: not a results file of this SDK"
        if version not in (0, SCHEMA) or (version == 0 and (found or not create)):
            raise InputError(f"{other} (schema {version}, expected {SCHEMA})")
        if version and found != _SCHEMA:
            raise InputError(f"{other}: other tables than evlcp sweep makes")
        if create:
            self._base.execute("PRAGMA journal_mode = WAL")
            self._base.execute("PRAGMA synchronous = FULL")
            if version == 0:
                with self._writing():
                    # All or nothing: tables of no version are somebody else's.
                    script = f"BEGIN IMMEDIATE; {_TABLES} PRAGMA user_version = {SCHEMA}; COMMIT"
                    self._base.executescript(script)
            return
        # A page that is its own child would be read for ever.
        (state,) = self._base.execute("PRAGMA quick_check(1)").fetchone()
        if state != "ok":
            raise InputError(f"{self.path}: damaged results file: {' '.join(state.split())}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *fault: object) -> None:
        self._base.close()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.DatabaseError as fault:
            text = f"{self.path}: cannot be written: {fault}; what was finished is kept"
            raise OutputError(text) from fault

    @contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.DatabaseError, ValueError, TypeError, RecursionError, ConfigError) as fault:
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

    def plan(self) -> Plan:
        """The plan.

        Raises:
            InputError: There is none, or the file is damaged.
        """
        with self._reading():
            row = self._base.execute("SELECT body FROM plan").fetchone()
            if row is not None:
                return plan_from_dict(json.loads(row[0]))
        raise InputError(f"{self.path}: no campaign has started in it")

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
    line = (str(fault).splitlines() or [""])[0]
    return InputError(
        f"{path}: damaged, or no results file of evlcp sweep ({type(fault).__name__}: {line:.200})"
    )
