"""Named variants of a link."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.link.several import load_links, named_links
from evlcp_sdk.plugin.registry import Registry

_KEY = r"[\w-]+\s*\.\s*[\w-]+\s*(?:\.\s*[\w-]+\s*)?="
_SETTING = re.compile(rf"{_KEY}.*", re.DOTALL)
_AT_SETTING = re.compile(rf",(?=\s*{_KEY})")
"""A comma is part of a value, as in `[1, 14]`, unless another setting follows it."""


@dataclass(frozen=True, eq=False)
class Variant:
    """A configuration with a name.

    Attributes:
        name: As the user calls it.
        settings: What sets it apart, e.g. `ranging.id=centroid`.
        links: The resolved configuration by name, which is empty for a single link.
    """

    name: str
    settings: tuple[str, ...]
    links: Mapping[str, Link]

    def to_dict(self) -> dict[str, Any]:
        """Settings, digest and resolved table as JSON values; of several links under `links`, by name."""
        described = {
            name: {
                "digest": link.digest,
                "configuration": {section: dict(keys) for section, keys in link.table.items()},
            }
            for name, link in self.links.items()
        }
        return {"settings": list(self.settings)} | described.get("", {"links": described})


def load_variants(
    texts: Sequence[str],
    path: Path | str | Sequence[Path | str] | None = None,
    overrides: Sequence[str] = (),
    registry: Registry | None = None,
) -> tuple[Variant, ...]:
    """Resolve variants, each `NAME:TABLE.KEY=VALUE,TABLE.KEY=VALUE`; `NAME:` is the link as it is.

    Args:
        texts: What `--variant` takes.
        path: The `link.toml` that they share, or several; None for all defaults.
        overrides: What `--set` takes; holds for all, and yields to a variant's own settings.
        registry: Where algorithms are found; None for all that are installed.

    Raises:
        ConfigError: All faults, one line each.

    >>> [v.settings for v in load_variants(["a:", "b:ranging.id=poc,ranging.clusters=[1, 14]"])]
    [(), ('ranging.id=poc', 'ranging.clusters=[1, 14]')]
    """
    registry = Registry.load() if registry is None else registry
    found: list[Variant] = []
    faults: list[str] = []
    for text in texts:
        name, colon, rest = text.partition(":")
        name = name.strip()
        settings = tuple(part.strip() for part in _AT_SETTING.split(rest)) if rest.strip() else ()
        odd = [s for s in settings if not _SETTING.fullmatch(s)]
        if not colon or not name or odd:
            what = f" ('{odd[0]}')" if odd else ""
            faults.append(
                f"--variant {text}{what}: expected NAME:TABLE.KEY=VALUE,..., e.g. mine:ranging.id=poc"
            )
            continue
        if name in [v.name for v in found]:
            faults.append(f"--variant {text}: the name '{name}' is taken by another variant")
            continue
        try:
            links = load_links(path, [*overrides, *settings], registry)
            found.append(Variant(name, settings, named_links(links)))
        except ConfigError as fault:
            for line in str(fault).splitlines():
                here = line.removeprefix("--set: ")
                faults.append(f"--variant {name}: {here}" if _is_about(here, settings) else line)
    if faults:
        raise ConfigError("\n".join(dict.fromkeys(faults)))
    return tuple(found)


def _is_about(fault: str, settings: Iterable[str]) -> bool:
    """Whether a fault is one of these settings: it starts with the key, or names the unknown id."""
    pairs = [[part.strip() for part in setting.split("=", 1)] for setting in settings]
    # What names a link first names it for that link alone.
    pairs = [[".".join(key.split(".")[-2:]), value] for key, value in pairs]
    return any(fault.startswith(key) or f"named '{value}'" in fault for key, value in pairs)
