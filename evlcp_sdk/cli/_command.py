"""Functions as commands: parameters may be groups of options, and help may hide rare options."""

import inspect
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import wraps
from typing import Annotated, Any, get_type_hints

import typer

from evlcp_sdk.cli._common import echo


def _show_full_help(ctx: typer.Context, show: bool) -> None:
    if not show:
        return
    for parameter in ctx.command.params:
        parameter.hidden = False  # type: ignore[attr-defined]
    echo(ctx.get_help())
    raise typer.Exit


_HelpAll = Annotated[
    bool, typer.Option("--help-all", callback=_show_full_help, is_eager=True, help="Show rarer options, too.")
]


def command(function: Callable[..., None]) -> Callable[..., None]:
    """Make a function a command for Typer, with an option for every field of a parameter that is a dataclass.

    Help shows options of a dataclass with a `PANEL` under that title, and hidden ones with `--help-all`.

    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True)
    ... class Place:
    ...     x_m: float = 0.0
    ...     y_m: float = 0.0
    >>> def go(name: str, place: Place) -> None:
    ...     assert place == Place(1.0, 2.0)
    >>> command(go)(name="there", x_m=1.0, y_m=2.0)
    """
    hints = get_type_hints(function, include_extras=True)
    options: list[inspect.Parameter] = []
    groups: dict[str, type[Any]] = {}
    for parameter in inspect.signature(function).parameters.values():
        kind = hints[parameter.name]
        if not is_dataclass(kind):
            options.append(parameter.replace(annotation=kind, kind=parameter.KEYWORD_ONLY))
            continue
        assert isinstance(kind, type)
        groups[parameter.name] = kind
        field_hints = get_type_hints(kind, include_extras=True)
        for f in fields(kind):
            for info in getattr(field_hints[f.name], "__metadata__", ()):
                info.rich_help_panel = getattr(kind, "PANEL", None)
            options.append(
                inspect.Parameter(
                    f.name, parameter.KEYWORD_ONLY, default=f.default, annotation=field_hints[f.name]
                )
            )
    infos = [info for one in options for info in getattr(one.annotation, "__metadata__", ())]
    if any(getattr(info, "hidden", False) for info in infos):
        options.append(
            inspect.Parameter("help_all", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=_HelpAll)
        )

    @wraps(function)
    def run(**values: Any) -> None:
        values.pop("help_all", None)
        for name, kind in groups.items():
            values[name] = kind(**{f.name: values.pop(f.name) for f in fields(kind)})
        function(**values)

    run.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    run.__annotations__ = {one.name: one.annotation for one in options}
    return run
