"""`evlcp plugins`."""

import typer

from evlcp_sdk.cli._common import Json

__all__ = ["register"]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("plugins")(plugins)


def plugins(as_json: Json = False) -> None:
    """List the installed algorithms: role, id, distribution, version, summary.

    Select one by its id: [bold]evlcp receive REC.raw -o out --set modulation.id=wh8[/]
    """
    import json

    from evlcp_sdk.plugin.registry import Registry

    rows = [
        {
            "role": e.algorithm.role,
            "id": e.algorithm.id,
            "distribution": e.distribution,
            "version": e.version,
            "revision": e.algorithm.revision,
            "summary": e.algorithm.summary,
        }
        for e in Registry.load().installed()
    ]
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
        return
    keys = ("role", "id", "distribution", "version", "summary")
    widths = [max((len(str(r[k])) for r in rows), default=0) for k in keys]
    for r in rows:
        typer.echo("  ".join(f"{r[k]!s:<{w}}" for k, w in zip(keys, widths, strict=True)).rstrip())
