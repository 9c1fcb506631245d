"""`evlcp check`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._common import Json, LinkFile, console, print_result
from evlcp_sdk.errors import ConfigError

_WIDTH = 18
"""Of a law's name: the longest is `codewords-distinct`."""

_STYLES = {"ok": "green", "failed": "bold red", "skipped": "dim", "excused": "yellow"}


def check(
    role: Annotated[
        str | None, typer.Argument(metavar="[ROLE", help="What the algorithm does, e.g. ranging.")
    ] = None,
    id: Annotated[
        str | None, typer.Argument(metavar="ID]", help="Its id, as `evlcp plugins` lists it.")
    ] = None,
    link_file: LinkFile = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="[TABLE.]KEY=VALUE",
            help="Another value of the link; without a table, a parameter of the algorithm; may be repeated.",
        ),
    ] = None,
    excuses: Annotated[
        list[str] | None,
        typer.Option(
            "--excuse",
            metavar="LAW=REASON",
            help="A law of the algorithm that is known to be broken, and why; may be repeated.",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Hold an algorithm, or all of a link, against the laws of roles.

    A built-in one:      [bold]evlcp check ranging poc[/]
    With a parameter:    [bold]evlcp check ranging poc --set min_pixels=6[/]
    On another link:     [bold]evlcp check ranging poc -c link.toml --set bar.rows=24[/]
    A whole link:        [bold]evlcp check -c link.toml[/]
    For a script:        [bold]evlcp check decoding ml-soft --json[/]

    `-c` and `--set TABLE.KEY` say what the rest of the link is; without them it is the default.
    One line per law: ok, failed (what was expected), skipped (why it does not apply), excused (by you).
    An excused law that holds is a failure. Exit code 0: no failure, 1: a law is broken.
    """
    if role is None:
        if excuses:
            raise ConfigError("--excuse: expected ROLE and ID, whose law it is")
        name, table = _check_link(link_file, overrides or [], as_json=as_json)
    elif id is None:
        raise ConfigError(f"check {role}: expected ROLE and ID, or neither for a whole link")
    else:
        name, table = _check_algorithm(role, id, link_file, overrides or [], excuses or [], as_json=as_json)
    statuses = [law["status"] for law in table["laws"]]
    failed = statuses.count("failed")
    counts = (f"{n} {status}" for status in _STYLES if (n := statuses.count(status)))
    print_result(f"{name}: {', '.join(counts)}", table | {"failed": failed}, as_json, 2)
    raise typer.Exit(1 if failed else 0)


def _check_link(
    link_file: str | None, overrides: Sequence[str], *, as_json: bool
) -> tuple[str, dict[str, Any]]:
    """Check a link against its laws, and print each outcome at once; return its name and the JSON table."""
    link = sdk.resolve.load_link(link_file, overrides)
    ids = {role: link.table[role]["id"] for role in link.algorithms}
    laws: list[dict[str, str | None]] = []
    for role, outcome in sdk.suite.check_link(link):
        id = ids.get(role)
        if not as_json and (not laws or laws[-1]["role"] != role):
            console().print("the link" if id is None else f"{role} '{id}'", style="bold")
        laws.append({"role": role, "id": id, **_report_outcome(outcome, as_json)})
    return link_file or "the default link", {"link": link.digest, "laws": laws}


def _check_algorithm(
    role: str,
    id: str,
    link_file: str | None,
    overrides: Sequence[str],
    excuses: Sequence[str],
    *,
    as_json: bool,
) -> tuple[str, dict[str, Any]]:
    """Check an algorithm against the laws of its role, likewise."""
    sdk.testing.laws_of(role)
    registry = sdk.registry.Registry.load()
    entry = registry.find(role, id)
    reasons = {}
    for text in excuses:
        law, equals, reason = text.partition("=")
        if not equals:
            raise ConfigError(f"--excuse {text}: expected LAW=REASON")
        reasons[law.strip()] = reason.strip()
    link = _build_link(role, id, link_file, overrides, registry)
    outcomes = sdk.suite.check_laws(role, link.algorithm(role), reasons, link)
    table = {
        "role": role,
        "id": id,
        "distribution": entry.distribution,
        "version": entry.version,
        "link": link.digest,
        "parameters": {k: v for k, v in link.table[role].items() if k != "id"},
        "laws": [_report_outcome(outcome, as_json) for outcome in outcomes],
    }
    return f"{role} '{id}' of {entry.distribution} {entry.version}", table


def _report_outcome(outcome: sdk.testing.Verdict, as_json: bool) -> dict[str, str]:
    """Print a verdict at once, unless as JSON; return its JSON."""
    law = outcome.law
    if not as_json:
        from rich.text import Text

        text = law.statement if outcome.status == "ok" else " ".join(outcome.detail.split())
        status = f"{outcome.status:<7}", _STYLES[outcome.status]
        console().print(Text.assemble(status, f"  {law.name:<{_WIDTH}}  {text}"))
    return {"law": law.name, "says": law.statement, "status": outcome.status, "detail": outcome.detail}


def _build_link(
    role: str, id: str, link_file: str | None, overrides: Sequence[str], registry: sdk.registry.Registry
) -> sdk.resolve.Link:
    own: dict[str, object] = {}
    rest = []
    for override in overrides:
        name, equals, value = override.partition("=")
        table, dot, key = (part.strip() for part in name.rpartition("."))
        if not (equals and key) or (dot and not table):
            raise ConfigError(f"--set {override}: expected KEY=VALUE or TABLE.KEY=VALUE")
        if not dot or table == role:
            if key == "id":
                raise ConfigError(f"--set {override}: the algorithm is {role} {id}, as given")
            own[key] = sdk.specs.parse_value(value)
        else:
            rest.append(override)
    link = sdk.resolve.load_link(link_file, rest, registry)
    # Parameters in the file belong to the algorithm that the file selects.
    keys = link.table.get(role, {"id": id})
    keys = keys if keys["id"] == id else {"id": id}
    tables = {**link.table, role: {**keys, **own}}
    overridden = frozenset((role, key) for key in own)
    if role == "framing" and link.table[role]["id"] != id:
        # Another framing's steps are not its own, and the default bar may not suit it.
        tables = {name: values for name, values in tables.items() if name not in sdk.roles.STEPS}
        if link_file is None and not any(name.startswith("bar.") for name in rest):
            try:
                return sdk.resolve.resolve(tables, registry, overridden=overridden)
            except ConfigError:
                tables["bar"] = dict(sdk.exercises.ONE_CLUSTER)
    return sdk.resolve.resolve(tables, registry, source=link_file or "", overridden=overridden)
