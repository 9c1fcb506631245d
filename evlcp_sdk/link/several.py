"""Several links of one receiver: their names, and what they must have in common."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.plugin.registry import Registry

LinkLike = Link | Path | str | None


def load_links(
    link: LinkLike | Sequence[Link | Path | str],
    overrides: Sequence[str] = (),
    registry: Registry | None = None,
) -> tuple[Link, ...]:
    """Load links from files; links that are given are kept, and None is one of all defaults.

    Args:
        link: A link, a `link.toml`, or several of these.
        overrides: `table.key=value` texts that change the links from files; `name.table.key=value` changes
            only the one of that name.
        registry: The algorithms; None for all that are installed.

    Raises:
        ConfigError: A file does not describe a link, or they cannot be received together.
    """
    items: Sequence[LinkLike] = [link] if link is None or isinstance(link, Link | Path | str) else link
    names = [item.name if isinstance(item, Link) else Path(item).stem if item else "" for item in items]
    links = tuple(
        item
        if isinstance(item, Link)
        else load_link(item, _select_overrides(name, names, overrides), registry)
        for item, name in zip(items, names, strict=True)
    )
    name_links(links)
    return links


def _select_overrides(name: str, names: Sequence[str], overrides: Sequence[str]) -> list[str]:
    """The overrides of one of several links: those of all links, and those with its name."""
    if len(names) == 1:
        return list(overrides)
    selected = []
    for text in overrides:
        key = text.partition("=")[0]
        if key.count(".") < 2:
            selected.append(text)
            continue
        owner = key.partition(".")[0].strip()
        if owner not in names:
            raise ConfigError(f"--set {text}: no link is named '{owner}': expected one of {', '.join(names)}")
        if owner == name:
            selected.append(text.partition(".")[2])
    return selected


def name_links(link: Link | Sequence[Link]) -> dict[str, Link]:
    """Links by name: a single one has none; of several, those without a name get one from their index.

    Raises:
        ConfigError: There are none, two have one name, cameras or time steps differ, or nothing on air
            distinguishes two of them.

    >>> from evlcp_sdk.link.resolve import load_link
    >>> list(name_links([load_link(), load_link(overrides=["modulation.id=wh8"])]))
    ['link-0', 'link-1']
    >>> list(name_links(load_link()))
    ['']
    """
    unnamed = [link] if isinstance(link, Link) else list(link)
    if not unnamed:
        raise ConfigError("no link: expected one or more")
    if len(unnamed) == 1:
        return {"": unnamed[0]}
    links: dict[str, Link] = {}
    for place, one in enumerate(unnamed):
        name = one.name or f"link-{place}"
        if name in links:
            raise ConfigError(f"two links are named '{name}': expected another name for each file")
        for other_name, other in links.items():
            _check_pair(other_name, other, name, one)
        links[name] = one
    return links


def select_positioning_links(links: Mapping[str, Link]) -> dict[str, Link]:
    """The links, by name, with bars for positions: the only one, or those of more than one cluster.

    Raises:
        ConfigError: None of several links has such bars, or these differ in `[position]`.
    """
    if len(links) == 1:
        return dict(links)
    # A framing with its own receiver gives no points in the image.
    bars = {n: one for n, one in links.items() if one.bar.clusters > 1 and "separation" in one.algorithms}
    if not bars:
        raise ConfigError("positions are computed from bars of more than one cluster, and no link has any")
    first, *others = bars
    for name in others:
        if bars[name].position != bars[first].position:
            raise ConfigError(
                f"links '{first}' and '{name}': [position] differs; expected one for all of them"
            )
    return bars


def find_ambiguous_links(links: Mapping[str, Link]) -> list[tuple[str, str]]:
    """Pairs of links, by name, of which one may decode what the other sends, so that rows may be of either.

    Their LEDs rest while nothing is sent, their rates differ by no more than `Framing.clock_share`, and each
    codeword of one, without its longer rest, is a codeword of the other.

    >>> from evlcp_sdk.link.resolve import load_link
    >>> one_led = ["bar.rows=1", "bar.columns=1", "bar.cluster_rows=1", "bar.cluster_columns=1"]
    >>> lamp = load_link(None, [*one_led, "framing.id=uart"])
    >>> other = load_link(None, [*one_led, "framing.id=uart", "framing.idle=off"])
    >>> find_ambiguous_links({"lamp": lamp, "other": other})
    [('lamp', 'other')]
    """
    pairs = []
    for (name, one), (other_name, other) in combinations(links.items(), 2):
        ours, theirs = _rest_mask(one), _rest_mask(other)
        if ours is None or theirs is None:
            continue
        share = max(link.algorithm("framing").clock_share for link in (one, other))
        difference = abs(one.air.chip_rate_hz / other.air.chip_rate_hz - 1)
        if difference <= share and (_is_contained(ours, theirs) or _is_contained(theirs, ours)):
            pairs.append((name, other_name))
    return pairs


def _rest_mask(link: Link) -> NDArray[np.bool_] | None:
    """A link's codewords, true where LEDs are as at rest; None if it has no such state."""
    framing = link.algorithms.get("framing")
    rest = framing.rest() if framing is not None else None
    return None if rest is None else link.codebook.codewords == rest


def _is_contained(words: NDArray[np.bool_], others: NDArray[np.bool_]) -> bool:
    """Whether all words, cut where they only rest, are among others that are not longer."""
    length = others.shape[1]
    if words.shape[1] < length or not words[:, length:].all():
        return False
    other_rows = {row.tobytes() for row in others}
    return all(row.tobytes() in other_rows for row in np.ascontiguousarray(words[:, :length]))


def _check_pair(name: str, one: Link, other_name: str, other: Link) -> None:
    both = f"'{name}' and '{other_name}'"
    for section in ("camera", "camera_sigma"):
        if getattr(one, section) != getattr(other, section):
            raise ConfigError(f"links {both}: [{section}] differs; expected one camera for all of them")
    if one.regions.step_us != other.regions.step_us:
        steps = f"{one.regions.step_us} and {other.regions.step_us}"
        raise ConfigError(f"links {both}: regions.step_us = {steps}: expected one for all of them")
    if one.codebook == other.codebook and one.packet == other.packet:
        raise ConfigError(f"links {both}: they send alike, so that nothing tells one from the other")
