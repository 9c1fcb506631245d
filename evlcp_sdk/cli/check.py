"""`evlcp check`."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from evlcp_sdk.cli._common import Json, LinkFile, console, echo

if TYPE_CHECKING:
    from evlcp_sdk.link.resolve import Link
    from evlcp_sdk.plugin.registry import Registry
    from evlcp_sdk.testing import Verdict

__all__ = ["check", "register"]

_STYLES = {"ok": "green", "failed": "bold red", "skipped": "dim", "excused": "yellow"}


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("check")(check)


def check(
    role: Annotated[str, typer.Argument(metavar="ROLE", help="What the algorithm does, e.g. ranging.")],
    id: Annotated[str, typer.Argument(metavar="ID", help="Its id, as `evlcp plugins` lists it.")],
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
            help="A law that is known to be broken, and why; may be repeated.",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Hold an installed algorithm, yours or ours, against the laws of its role.

    A built-in one:      [bold]evlcp check ranging poc[/]

    With a parameter:    [bold]evlcp check ranging poc --set min_pixels=6[/]

    On another link:     [bold]evlcp check ranging poc -c link.toml --set bar.rows=24[/]

    For a script:        [bold]evlcp check decoding ml-soft --json[/]

    `-c` and `--set TABLE.KEY` say what the rest of the link is; without them it is the default.
    One line per law: ok, failed (what was expected), skipped (why it does not apply), excused (by you).
    An excused law that holds is a failure. Exit code 0: no failure, 1: a law is broken.
    """
    import json

    from evlcp_sdk.errors import ConfigError
    from evlcp_sdk.plugin.registry import Registry
    from evlcp_sdk.testing import check as hold
    from evlcp_sdk.testing import laws_of

    laws_of(role)
    registry = Registry.load()
    entry = registry.find(role, id)
    reasons = {}
    for text in excuses or []:
        law, equals, reason = text.partition("=")
        if not equals:
            raise ConfigError(f"--excuse {text}: expected LAW=REASON")
        reasons[law.strip()] = reason.strip()
    link = _link(role, id, link_file, overrides or [], registry)
    outcomes = hold(role, link.algorithm(role), reasons, link)
    failed = sum(outcome.status == "failed" for outcome in outcomes)
    if as_json:
        echo(
            json.dumps(
                {
                    "role": role,
                    "id": id,
                    "distribution": entry.distribution,
                    "version": entry.version,
                    "link": link.digest,
                    "parameters": {k: v for k, v in link.table[role].items() if k != "id"},
                    "failed": failed,
                    "laws": [
                        {"law": o.law.name, "says": o.law.says, "status": o.status, "detail": o.detail}
                        for o in outcomes
                    ],
                },
                indent=2,
            )
        )
    else:
        _show(outcomes)
        counts = [f"{n} {s}" for s in _STYLES if (n := sum(o.status == s for o in outcomes))]
        console().print(f"{role} '{id}' of {entry.distribution} {entry.version}: {', '.join(counts)}")
    raise typer.Exit(1 if failed else 0)


def _link(
    role: str, id: str, link_file: str | None, overrides: Sequence[str], registry: "Registry"
) -> "Link":
    """The link with the algorithm in its role."""
    from evlcp_sdk.errors import ConfigError
    from evlcp_sdk.link.resolve import load_link, resolve
    from evlcp_sdk.specs import parse_value

    own: dict[str, object] = {}
    rest = []
    for override in overrides:
        name, equals, value = override.partition("=")
        table, dot, key = (part.strip() for part in name.rpartition("."))
        if not (equals and key) or (dot and not table):
            raise ConfigError(f"--set {override}: expected KEY=VALUE or TABLE.KEY=VALUE")
        if not dot or table == role:
            own[key] = parse_value(value)
        else:
            rest.append(override)
    link = load_link(link_file, rest, registry)
    # Parameters in the file are of the algorithm that the file selects.
    keys = link.table[role] if link.table[role]["id"] == id else {"id": id}
    changed = {**link.table, role: {**keys, **own}}
    return resolve(
        changed, registry, source=link_file or "", overridden=frozenset((role, key) for key in own)
    )


def _show(outcomes: "list[Verdict]") -> None:
    from rich.text import Text

    out = console()
    width = max(len(o.law.name) for o in outcomes)
    for o in outcomes:
        text = o.law.says if o.status == "ok" else " ".join(o.detail.split())
        out.print(Text.assemble((f"{o.status:<7}", _STYLES[o.status]), f"  {o.law.name:<{width}}  {text}"))
