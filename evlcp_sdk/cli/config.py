"""`evlcp config`."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._common import Json, LinkFile, Overrides, echo, print_json


def config(
    link_file: LinkFile = None,
    overrides: Overrides = None,
    digest: Annotated[bool, typer.Option("--digest", help="Only the SHA-256 of the link.")] = False,
    as_json: Json = False,
    codebook: Annotated[
        Literal["json", "c"] | None,
        typer.Option(help="Only the codes that both ends share, as JSON or as a C header."),
    ] = None,
) -> None:
    """Print the resolved link, each value with its meaning and bounds.

    Start your own:            [bold]evlcp config > link.toml[/]
    See what a change does:    [bold]evlcp config -c link.toml --set modulation.id=wh8 --digest[/]
    Codes for the transmitter: [bold]evlcp config --codebook c > codebook.h[/]
    """
    if digest + as_json + (codebook is not None) > 1:
        raise typer.BadParameter("give one of --digest, --json and --codebook", param_hint="--json")
    registry = sdk.registry.Registry.load()
    link = sdk.resolve.load_link(link_file, overrides or [], registry)
    if codebook is not None:
        echo(link.codebook.to_json() if codebook == "json" else link.codebook.to_c())
        return
    # A receiver compiles its algorithms, so that what they refuse is reported here.
    sdk.receiver.Receiver(link)
    if digest:
        echo(link.digest)
    elif as_json:
        table = {
            "digest": link.digest,
            "codebook": {"digest": link.codebook.digest, "profile": link.codebook.profile},
            "revisions": link.revisions,
            "configuration": link.table,
        }
        print_json(table, 2)
    else:
        echo(sdk.text.to_toml(link, registry), nl=False)
