"""Several links of one receiver: their names, and what they must share."""

from collections.abc import Sequence

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import Link

__all__ = ["named_links"]


def named_links(link: Link | Sequence[Link]) -> dict[str, Link]:
    """Links by name; one without a name is called by its place, from `link-0` on.

    Args:
        link: A link, or several.

    Raises:
        ConfigError: There are none, two have one name, cameras or steps in time differ, or nothing on air
            tells two of them apart.

    >>> from evlcp_sdk.link.resolve import load_link
    >>> list(named_links([load_link(), load_link(overrides=["modulation.id=wh8"])]))
    ['link-0', 'link-1']
    """
    given = [link] if isinstance(link, Link) else list(link)
    if not given:
        raise ConfigError("no link: expected one or more")
    links: dict[str, Link] = {}
    for place, one in enumerate(given):
        name = one.name or f"link-{place}"
        if name in links:
            raise ConfigError(f"two links are named '{name}': expected another name for each file")
        for other_name, other in links.items():
            _check(other_name, other, name, one)
        links[name] = one
    return links


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
