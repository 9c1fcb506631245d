"""All laws of a role; an algorithm held against them."""

from collections.abc import Mapping
from typing import Any

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.hooks import ROLE_NAMES
from evlcp_sdk.testing.codes import MODULATION, PILOTS
from evlcp_sdk.testing.corrections import ERROR_CORRECTION
from evlcp_sdk.testing.form import DESCRIPTION, FUNCTION, RESULT
from evlcp_sdk.testing.images import DECODING, RANGING, SEPARATION
from evlcp_sdk.testing.law import Law, Outcome, Subject, judge
from evlcp_sdk.testing.links import LINK
from evlcp_sdk.testing.streams import SYNCHRONIZATION, TRACKING

__all__ = ["check", "checked_excuses", "laws_of"]


def laws_of(role: str) -> tuple[Law, ...]:
    """The laws of a role, in order: description, function, result, the role's own, the link.

    Raises:
        ConfigError: There is no such role.

    >>> [law.name for law in laws_of("ranging")][-3:]
    ['sees-nothing', 'clean-link', 'sparse-pilots']
    """
    if role not in ROLE_NAMES:
        raise ConfigError(f"no role named '{role}' (known: {', '.join(ROLE_NAMES)})")
    if role == "pilots":
        return DESCRIPTION + RESULT + PILOTS + LINK
    if role == "modulation":
        return DESCRIPTION + RESULT + MODULATION + LINK
    if role == "error-correction":
        return DESCRIPTION + FUNCTION + RESULT + ERROR_CORRECTION
    own = {
        "synchronization": SYNCHRONIZATION,
        "separation": SEPARATION,
        "decoding": DECODING,
        "ranging": RANGING,
        "tracking": TRACKING,
    }
    return DESCRIPTION + FUNCTION + RESULT + own[role] + LINK


def checked_excuses(role: str, excuses: Mapping[str, str]) -> dict[str, str]:
    """The excuses, if each names a law of the role and gives a reason.

    Raises:
        ConfigError: It does not.
    """
    names = [law.name for law in laws_of(role)]
    for name, reason in excuses.items():
        if name not in names:
            raise ConfigError(f"no {role} law named '{name}' (known: {', '.join(names)})")
        if not reason.strip():
            raise ConfigError(f"excuse from '{name}': expected a reason")
    return dict(excuses)


def check(role: str, algorithm: Any, excuses: Mapping[str, str] | None = None) -> list[Outcome]:
    """Hold an algorithm against every law of its role.

    Args:
        role: One of `ROLE_NAMES`.
        algorithm: The algorithm, with the parameters to be tested.
        excuses: Law to the reason why it is known to be broken. An excused law must be broken: if it holds,
            or does not apply, that is a failure.

    Raises:
        ConfigError: There is no such role or law, or an excuse has no reason.

    >>> from evlcp_sdk.link.resolve import load_link
    >>> {outcome.status for outcome in check("modulation", load_link().algorithm("modulation"))}
    {'ok'}
    """
    known = checked_excuses(role, excuses or {})
    subject = Subject(role, algorithm)
    return [judge(law, subject, known) for law in laws_of(role)]
