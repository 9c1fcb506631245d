"""Several links of one receiver: their names, and what they must share."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.plugin.registry import Registry

__all__ = ["load_links", "named_links", "placing_links"]

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
