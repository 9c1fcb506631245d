"""Several links of one receiver: their names, and what they must share."""

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
    """Links, or the files of some, resolved: one of all defaults where none is given.

    Args:
        link: A link, a `link.toml`, or several of these.
        overrides: `table.key=value` texts that change those that are read from files; of several,
            `name.table.key=value` changes the one of that name.
        registry: Where algorithms are found; None for all that are installed.

    Raises:
        ConfigError: A file does not describe a link, or they cannot be received together.
    """
    given: Sequence[LinkLike] = [link] if link is None or isinstance(link, Link | Path | str) else link
    names = [one.name if isinstance(one, Link) else Path(one).stem if one else "" for one in given]
    links = tuple(
        one if isinstance(one, Link) else load_link(one, _overrides_of(name, names, overrides), registry)
        for one, name in zip(given, names, strict=True)
    )
    named_links(links)
    return links


def _overrides_of(name: str, names: Sequence[str], overrides: Sequence[str]) -> list[str]:
    """The overrides that one of several links takes: those of all links, and those that name it."""
    if len(names) == 1:
        return list(overrides)
    taken = []
    for text in overrides:
        key = text.partition("=")[0]
        if key.count(".") < 2:
            taken.append(text)
            continue
        which = key.partition(".")[0].strip()
        if which not in names:
            raise ConfigError(f"--set {text}: no link is named '{which}': expected one of {', '.join(names)}")
        if which == name:
            taken.append(text.partition(".")[2])
    return taken


def named_links(link: Link | Sequence[Link]) -> dict[str, Link]:
    """Links by name: a single one has none, of several one without a name is called by its place.

    Args:
        link: A link, or several.

    Raises:
        ConfigError: There are none, two have one name, cameras or steps in time differ, or nothing on air
            tells two of them apart.

    >>> from evlcp_sdk.link.resolve import load_link
    >>> list(named_links([load_link(), load_link(overrides=["modulation.id=wh8"])]))
    ['link-0', 'link-1']
    >>> list(named_links(load_link()))
    ['']
    """
    given = [link] if isinstance(link, Link) else list(link)
    if not given:
        raise ConfigError("no link: expected one or more")
    if len(given) == 1:
        return {"": given[0]}
    links: dict[str, Link] = {}
    for place, one in enumerate(given):
        name = one.name or f"link-{place}"
        if name in links:
            raise ConfigError(f"two links are named '{name}': expected another name for each file")
        for other_name, other in links.items():
            _check(other_name, other, name, one)
        links[name] = one
    return links


def placing_links(links: Mapping[str, Link]) -> dict[str, Link]:
    """The links whose bars positions are computed from: of several, those that show more than one cluster.

    Args:
        links: As `named_links` gives them.

    Raises:
        ConfigError: Of several links, none has such bars, or these differ in `[position]`.
    """
    if len(links) == 1:
        return dict(links)
    # What a framing receives by itself has no points in the image.
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


def alike_links(links: Mapping[str, Link]) -> list[tuple[str, str]]:
    """Pairs of links of which what one sends can be read by the other, so that rows may name the wrong one.

    Of framings that read transmitters that rest between characters, whichever way round the light is, with
    a clock that is known to `Framing.clock_share`: their rates are not further apart than that, and each
    codeword of one, but for what it rests longer, is one of the other.

    Args:
        links: As `named_links` gives them.

    >>> from evlcp_sdk.link.resolve import load_link
    >>> one_led = ["bar.rows=1", "bar.columns=1", "bar.cluster_rows=1", "bar.cluster_columns=1"]
    >>> lamp = load_link(None, [*one_led, "framing.id=uart"])
    >>> other = load_link(None, [*one_led, "framing.id=uart", "framing.idle=off"])
    >>> alike_links({"lamp": lamp, "other": other})
    [('lamp', 'other')]
    """
    pairs = []
    for (name, one), (other_name, other) in combinations(links.items(), 2):
        ours, theirs = _rested(one), _rested(other)
        if ours is None or theirs is None:
            continue
        share = max(link.algorithm("framing").clock_share for link in (one, other))
        apart = abs(one.air.chip_rate_hz / other.air.chip_rate_hz - 1)
        if apart <= share and (_within(ours, theirs) or _within(theirs, ours)):
            pairs.append((name, other_name))
    return pairs


def _rested(link: Link) -> NDArray[np.bool_] | None:
    """A link's codewords, true where the light is as at rest; None where it has no rest that is known."""
    framing = link.algorithms.get("framing")
    rest = framing.rest() if framing is not None else None
    return None if rest is None else link.codebook.codewords == rest


def _within(words: NDArray[np.bool_], others: NDArray[np.bool_]) -> bool:
    """Whether all words are among others that are not longer, resting from there on."""
    length = others.shape[1]
    if words.shape[1] < length or not words[:, length:].all():
        return False
    known = {row.tobytes() for row in others}
    return all(row.tobytes() in known for row in np.ascontiguousarray(words[:, :length]))


def _check(name: str, one: Link, other_name: str, other: Link) -> None:
    """Refuse two links that cannot be received together."""
    both = f"'{name}' and '{other_name}'"
    for section in ("camera", "camera_sigma"):
        if getattr(one, section) != getattr(other, section):
            raise ConfigError(f"links {both}: [{section}] differs; expected one camera for all of them")
    if one.regions.step_us != other.regions.step_us:
        steps = f"{one.regions.step_us} and {other.regions.step_us}"
        raise ConfigError(f"links {both}: regions.step_us = {steps}: expected one for all of them")
    if one.codebook == other.codebook and one.packet == other.packet:
        raise ConfigError(f"links {both}: they send alike, so that nothing tells one from the other")
