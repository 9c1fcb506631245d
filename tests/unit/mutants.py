"""JSON values changed at one place: what a damaged or hostile file holds."""

import copy
import random
from collections.abc import Callable, Iterator
from typing import Any

from evlcp_sdk.errors import EvlcpError

ODD = (
    *(None, True, 0, -1, 0.5, 1e308, -1e308, 1e-308, float("nan"), float("inf"), 10**30, 2**63, -(2**63)),
    *("", "x", "9" * 50, "<img src=x onerror=alert(1)>", "a\nb", "[/]", "$\\frac$"),
    *([], {}, [None], [[]], {"a": 1}),
)
"""What stands in the place of a value."""


def refusal(act: Callable[[], object]) -> str | None:
    """What an act is refused with; None where it is not."""
    try:
        act()
    except EvlcpError as told:
        return str(told)
    return None


def mutants(values: Any, number: int, seed: int) -> Iterator[tuple[Any, str]]:
    """Copies of JSON values, each with one removed, renamed, doubled or replaced, and what was done."""
    rng = random.Random(seed)
    for _ in range(number):
        mutant = copy.deepcopy(values)
        yield mutant, _change(mutant, rng)


def _change(mutant: Any, rng: random.Random) -> str:
    holder, key, path = mutant, None, ""
    while isinstance(mutant, dict | list) and mutant and (key is None or rng.random() < 0.85):
        holder = mutant
        key = rng.choice(list(holder) if isinstance(holder, dict) else range(min(len(holder), 5)))
        mutant, path = holder[key], f"{path}.{key}"
    way = rng.random()
    if way < 0.25:
        del holder[key]
        return f"{path} removed"
    if way < 0.35 and isinstance(holder, dict):
        holder["other"] = holder.pop(key)
        return f"{path} renamed"
    if way < 0.45 and isinstance(holder, list):
        holder.append(copy.deepcopy(mutant))
        return f"{path} doubled"
    holder[key] = rng.choice(ODD)
    return f"{path} = {holder[key]!r}"
