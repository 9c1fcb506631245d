"""Functions as commands, whose parameters may be groups of options."""

import inspect
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import wraps
from typing import Any, get_type_hints


def command(function: Callable[..., None]) -> Callable[..., None]:
    """A function as a command for Typer: of each parameter that is a dataclass, every field is an option.

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
        of_field = get_type_hints(kind, include_extras=True)
        options += [
            inspect.Parameter(f.name, parameter.KEYWORD_ONLY, default=f.default, annotation=of_field[f.name])
            for f in fields(kind)
        ]

    if not groups:
        return function

    @wraps(function)
    def run(**values: Any) -> None:
        for name, kind in groups.items():
            values[name] = kind(**{f.name: values.pop(f.name) for f in fields(kind)})
        function(**values)

    run.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    run.__annotations__ = {one.name: one.annotation for one in options}
    return run
