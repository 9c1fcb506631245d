"""Results as they come, in one SQLite file; what was saved survives the death of the writer.

The file is in WAL mode and every result is a transaction of its own, written through to the disk: a campaign
that is killed at any moment goes on where it was, and a report can be drawn while it runs. Results are kept
by task id, apart from the plan; a campaign that grows or shrinks finds those it shares with its former self.
"""

import json
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Self
from urllib.parse import quote

from evlcp_sdk.errors import ConfigError, InputError, OutputError
from evlcp_sdk.files import check_output
from evlcp_sdk.study.plan import Plan, plan_from_dict
from evlcp_sdk.study.tally import Statistics

SCHEMA = 4

_TABLES = f"""
BEGIN IMMEDIATE;
CREATE TABLE plan (id INTEGER PRIMARY KEY CHECK (id = 1), name TEXT NOT NULL, body TEXT NOT NULL);
CREATE TABLE result (
    task TEXT PRIMARY KEY, statistics TEXT NOT NULL, finished_at TEXT NOT NULL DEFAULT CURRENT_TIMESTAMP
) WITHOUT ROWID;
PRAGMA user_version = {SCHEMA};
COMMIT;
"""
"""All or nothing: tables without a version are not ours."""


class Store:
    """A results file; use as a context manager.

    Args:
        path: The file.
        create: Create it if it is missing; otherwise it is opened for reading only.

    Raises:
        InputError: It is missing, or no results file of this schema.
        OutputError: It cannot be written.
    """

    def __init__(self, path: Path, *, create: bool = False) -> None:
        self.path, self._create = path, create
        if create:
            check_output(path)
        elif not path.is_file():
            raise InputError(f"{path}: no results file there")
        with self._translate_errors():
            self._base = _connect(path, create=create)
        try:
            with self._translate_errors():
                self._check_schema()
        except BaseException:
            self._base.close()
            raise

    def _check_schema(self) -> None:
        """Refuse what is not a results file; create the tables of a new one."""
        (version,) = self._base.execute("PRAGMA user_version").fetchone()
        found = sorted(self._base.execute("SELECT type, name FROM sqlite_master"))
        new = self._create and version == 0 and not found
        if not new:
            other = f"{self.path}: not a results file of this SDK"
            if version != SCHEMA:
                raise InputError(f"{other} (schema {version}, expected {SCHEMA})")
            if found != [("table", "plan"), ("table", "result")]:
                raise InputError(f"{other}: other tables than evlcp sweep makes")
        if self._create:
            self._base.execute("PRAGMA journal_mode = WAL")
            self._base.execute("PRAGMA synchronous = FULL")
            if new:
                self._base.executescript(_TABLES)
        else:
            # A page that is its own child would be read forever.
            (state,) = self._base.execute("PRAGMA quick_check(1)").fetchone()
            if state != "ok":
                raise ValueError(state)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *fault: object) -> None:
        self._base.close()

    @contextmanager
    def _translate_errors(self) -> Iterator[None]:
        """Translate errors of SQLite to one line on the file."""
        try:
            yield
        except sqlite3.OperationalError as fault:
            if self._create:
                text = f"{self.path}: cannot be written: {fault}; what was finished is kept"
                raise OutputError(text) from fault
            raise InputError(f"{self.path}: {fault}") from fault
        except (sqlite3.DatabaseError, ValueError, TypeError, RecursionError, ConfigError) as fault:
            line = (str(fault).splitlines() or [""])[0]
            raise InputError(
                f"{self.path}: damaged, or no results file of evlcp sweep"
                f" ({type(fault).__name__}: {line:.200})"
            ) from fault

    def save_plan(self, plan: Plan) -> None:
        """Save a campaign's plan; a later plan of the same campaign replaces it.

        Raises:
            ConfigError: The file holds another campaign.
            InputError: The file is damaged.
            OutputError: The file cannot be written.
        """
        with self._translate_errors():
            row = self._base.execute("SELECT name FROM plan").fetchone()
        if row is not None and row[0] != plan.name:
            raise ConfigError(
                f"{self.path}: holds the campaign '{row[0]}', not '{plan.name}'; give another file"
            )
        with self._translate_errors():
            body = json.dumps(plan.to_dict())
            self._base.execute("INSERT OR REPLACE INTO plan VALUES (1, ?, ?)", (plan.name, body))

    def read_plan(self) -> Plan:
        """Read the plan.

        Raises:
            InputError: There is none, or the file is damaged.
        """
        with self._translate_errors():
            row = self._base.execute("SELECT body FROM plan").fetchone()
            if row is not None:
                return plan_from_dict(json.loads(row[0]))
        raise InputError(f"{self.path}: no campaign has started in it")

    def save_results(self, results: list[tuple[str, Statistics]]) -> None:
        """Save results of tasks, all or none; one that exists already stays.

        Raises:
            OutputError: The file cannot be written, e.g. the disk is full; what was saved before stays.
        """
        rows = [(task, json.dumps(statistics.to_dict(), sort_keys=True)) for task, statistics in results]
        with self._translate_errors():
            self._base.execute("BEGIN IMMEDIATE")
            with self._base:
                self._base.executemany("INSERT OR IGNORE INTO result (task, statistics) VALUES (?, ?)", rows)

    def read_results(self) -> dict[str, Statistics]:
        """Read the statistics of all tasks that have them, by task id.

        Raises:
            InputError: The file is damaged.
        """
        with self._translate_errors():
            rows = self._base.execute("SELECT task, statistics FROM result")
            return {task: Statistics.from_dict(json.loads(text)) for task, text in rows}


def _connect(path: Path, *, create: bool) -> sqlite3.Connection:
    mode = "mode=rwc"
    if not create:
        wal = path.with_name(f"{path.name}-wal")
        # Without a writer no further file is needed, so that the folder may be read-only.
        mode = "mode=ro" if wal.exists() and wal.stat().st_size else "mode=ro&immutable=1"
    url = f"file:{quote(str(path.absolute()))}?{mode}"
    return sqlite3.connect(url, timeout=30, isolation_level=None, uri=True)
