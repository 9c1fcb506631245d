"""The first page, what `evlcp --help` prints: in Typer's looks, at half the time to load what draws it.

Typer's own loads Markdown, syntax and tracebacks of Rich, too; a command's page is Typer's.
"""

from inspect import cleandoc
from typing import Any

from evlcp_sdk.cli._common import console

__all__ = ["print_front"]


def print_front(group: Any, ctx: Any) -> None:
    """Print usage, help, options and commands of a group whose options are plain flags.

    Args:
        group: The group, as Typer builds it, with `first_words` of its commands; its help is Rich's markup.
        ctx: Its context.
    """
    from rich.console import Group
    from rich.padding import Padding
    from rich.text import Text

    out = console()
    usage = Text(group.get_usage(ctx), "bold")
    usage.highlight_words(["Usage: "], "yellow")
    out.print(Padding(usage, 1), soft_wrap=False)
    first, *others = cleandoc(group.help or "").split("\n\n")
    parts = [_text(first.replace("\n", " "))]
    if others:
        parts += [Text(), _text("\n\n".join(others), style="dim")]
    out.print(Padding(Group(*parts), (0, 1, 1, 1)), soft_wrap=False)
    options = [
        (Text(",".join(o.opts), "bold cyan"), Text(o.display_type_rich(ctx=ctx) or "", "bold yellow"), o.help)
        for o in group.get_params(ctx)
        if not o.hidden
    ]
    _print_panel(out, "Options", options)
    shown = group.first_words(ctx)
    _print_panel(out, "Commands", [(Text(name, "bold cyan"), said) for name, said in shown])


def _text(markup: str, style: str = "") -> Any:
    """Text with markup; names of emojis, of which there are thousands, are none."""
    from rich.text import Text

    return Text.from_markup(markup, style=style, emoji=False)


def _print_panel(out: Any, title: str, rows: list[tuple[Any, ...]]) -> None:
    """Rows of texts, the last column with markup and taking all the room, in a frame."""
    from rich.panel import Panel
    from rich.table import Table

    table = Table(show_header=False, expand=True, box=None, pad_edge=False, padding=(0, 1))
    for _ in rows[0][:-1]:
        table.add_column(no_wrap=True)
    table.add_column(ratio=10)
    for *cells, said in rows:
        paragraph = cleandoc(said or "").split("\n\n")[0].replace("\n", " ")
        table.add_row(*cells, _text(paragraph))
    out.print(Panel(table, border_style="dim", title=title, title_align="left"), soft_wrap=False)
