"""What the commands share: their options, how a source is opened, what goes to stderr."""

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.console import Console

    from evlcp_sdk.io import EventSource
    from evlcp_sdk.registry import Registry

__all__ = ["Json", "LinkFile", "Overrides", "complain", "console", "open_source"]

LinkFile = Annotated[
    str | None, typer.Option("-c", "--config", metavar="link.toml", help="The link; all defaults without it.")
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="TABLE.KEY=VALUE", help="Override one value; may be repeated."),
]
Json = Annotated[bool, typer.Option("--json", help="JSON on stdout, nothing else.")]


def complain(text: str) -> None:
    """Print one line a fault on stderr."""
    for line in text.splitlines():
        typer.echo(f"evlcp: {line}", err=True)


def console() -> "Console":
    """Where tables go: stdout, without colour where it is no terminal or NO_COLOR is set."""
    from rich.console import Console

    return Console(highlight=False, soft_wrap=True)


def open_source(url: str, registry: "Registry") -> "EventSource":
    """Open a recording or a camera: plugins are asked first, then the built-in readers.

    Raises:
        InputError: It cannot be opened.
    """
    from evlcp_sdk.io import EventSource, open_events

    source = registry.hook.evlcp_open_events(url=url)
    return source if isinstance(source, EventSource) else open_events(url)
