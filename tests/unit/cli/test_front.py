"""The first page of the command line, beside the one that Typer itself draws."""

import pytest
import typer.main
from typer import rich_utils

from evlcp_sdk.cli._app import _called_late, add_plugin_commands, make_app
from evlcp_sdk.plugin.registry import Registry


@pytest.mark.parametrize("width", [60, 100, 140])
def test_the_first_page_says_what_typers_own_would(width, capsys, monkeypatch):
    for name in ("FORCE_COLOR", "GITHUB_ACTIONS", "PY_COLORS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("COLUMNS", str(width))
    app = make_app()
    add_plugin_commands(app, Registry.load())
    group = typer.main.get_command(app)
    with group.context_class(group, info_name="evlcp") as context:
        rich_utils.rich_format_help(obj=group, ctx=context, markup_mode="rich")
        theirs = capsys.readouterr().out
        group.format_help(context, context.make_formatter())
        ours = capsys.readouterr().out
    late = _called_late(app)
    with late.context_class(late, info_name="evlcp") as context:
        late.format_help(context, context.make_formatter())
    assert capsys.readouterr().out == ours
    # Nothing is built to say what there is.
    assert not late.commands

    def commands(page):
        return page[page.index(" Commands ") :]

    assert len(commands(ours).splitlines()) > 20
    # Typer's has room for short options, which there are none of, so its options break elsewhere.
    assert commands(ours) == commands(theirs)
    assert _words(ours) == _words(theirs)
    assert max(map(len, ours.splitlines())) == width


def _words(page):
    return [word for word in page.split() if not set(word) & set("│╭╮╰╯─")]
