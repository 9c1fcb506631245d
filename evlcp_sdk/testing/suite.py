"""Test an algorithm by all laws of its role, by a call or as tests of pytest."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.plugin.roles import ROLES
from evlcp_sdk.testing.codes import MODULATION, PILOTS
from evlcp_sdk.testing.corrections import ERROR_CORRECTION
from evlcp_sdk.testing.exercises import subject_of
from evlcp_sdk.testing.form import DESCRIPTION, FUNCTION, RESULT
from evlcp_sdk.testing.images import DECODING, RANGING, SEPARATION
from evlcp_sdk.testing.law import Law, LawError, Subject, Verdict, apply_law
from evlcp_sdk.testing.links import LINK
from evlcp_sdk.testing.streams import DETECTION, FRAMING, SYNCHRONIZATION, TRACKING

_FORM = DESCRIPTION + FUNCTION + RESULT
_LAWS: dict[str, tuple[Law, ...]] = {
    "detection": _FORM + DETECTION,
    "framing": _FORM + FRAMING,
    "pilots": DESCRIPTION + RESULT + PILOTS + LINK,
    "modulation": DESCRIPTION + RESULT + MODULATION + LINK,
    "synchronization": _FORM + SYNCHRONIZATION + LINK,
    "separation": _FORM + SEPARATION + LINK,
    "decoding": _FORM + DECODING + LINK,
    "ranging": _FORM + RANGING + LINK,
    "tracking": _FORM + TRACKING + LINK,
    "error-correction": _FORM + ERROR_CORRECTION,
}


def laws_of(role: str) -> tuple[Law, ...]:
    """Return the laws of a role, in order: description, function, result, the role's own, the link.

    Raises:
        ConfigError: There is no such role.

    >>> [law.name for law in laws_of("ranging")][-3:]
    ['sees-nothing', 'clean-link', 'sparse-pilots']
    """
    if role not in _LAWS:
        raise ConfigError(f"no role named '{role}' (known: {', '.join(ROLES)})")
    return _LAWS[role]


def _check_excuses(role: str, excuses: Mapping[str, str]) -> None:
    names = [law.name for law in laws_of(role)]
    for name, reason in excuses.items():
        if name not in names:
            raise ConfigError(f"no {role} law named '{name}' (known: {', '.join(names)})")
        if not reason.strip():
            raise ConfigError(f"excuse from '{name}': expected a reason")


def check(
    role: str, algorithm: Any, excuses: Mapping[str, str] | None = None, link: Link | None = None
) -> list[Verdict]:
    """Test an algorithm by every law of its role.

    Args:
        role: A name of `evlcp_sdk.plugin.roles.ROLES`.
        algorithm: The algorithm, with the parameters to be tested.
        excuses: Reasons of laws that are known to be broken, by law. An excused law that holds, or does not
            apply, is a failure.
        link: The rest of the link: bar, air, the algorithms of other roles; None for the default.

    Raises:
        ConfigError: There is no such role or law, or an excuse has no reason.

    >>> from evlcp_sdk.link.resolve import load_link
    >>> {outcome.status for outcome in check("modulation", load_link().algorithm("modulation"))}
    {'ok'}
    """
    return list(check_laws(role, algorithm, excuses or {}, link))


def check_laws(
    role: str, algorithm: Any, excuses: Mapping[str, str], link: Link | None = None
) -> Iterator[Verdict]:
    """`check`, law by law."""
    _check_excuses(role, excuses)
    subject = subject_of(role, algorithm, link)
    for law in laws_of(role):
        yield apply_law(law, subject, excuses)


def check_link(link: Link) -> Iterator[tuple[str, Verdict]]:
    """Test all algorithms of a link by the laws of their roles, and the link by its own.

    Yields:
        The role, or `link`, and the verdict of one of its laws. Laws of the whole link come once, last.

    >>> from evlcp_sdk.link.resolve import load_link
    >>> next(check_link(load_link()))[0]
    'detection'
    """
    for role in link.algorithms:
        subject = subject_of(role, link.algorithm(role), link)
        for law in laws_of(role):
            if law not in LINK:
                yield role, apply_law(law, subject, {})
    # The laws of a framing without the built-in steps are those of the whole link.
    if "decoding" in link.algorithms:
        subject = subject_of("decoding", link.algorithm("decoding"), link)
        for law in LINK:
            yield "link", apply_law(law, subject, {})


def conformance(
    role: str, *algorithms: Any, excuses: Mapping[str, str] | None = None, link: Link | None = None
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Make a test of pytest one test per law (and algorithm); its argument `check` tests the law.

    Args:
        role: The role of the algorithms.
        algorithms: The algorithms, with the parameters to be tested.
        excuses: Reasons of laws that are known to be broken, by law: expected failures, as in `check`.
        link: The rest of the link; None for the default.

    Raises:
        ConfigError: There is no such role or law, or an excuse has no reason.

    ```python
    @conformance("ranging", LineRanging(), LineRanging(min_clusters=4))
    def test_conformance(check):
        check()
    ```
    """
    import pytest

    excuses = excuses or {}
    _check_excuses(role, excuses)
    cases = []
    for number, algorithm in enumerate(algorithms):
        suffix = f"-{number}" if len(algorithms) > 1 else ""
        subject = subject_of(role, algorithm, link)
        for law in laws_of(role):
            run_law = partial(_end_test, law, subject, excuses)
            cases.append(pytest.param(run_law, id=f"{type(algorithm).__name__}{suffix}-{law.name}"))
    return pytest.mark.parametrize("check", cases)


def _end_test(law: Law, subject: Subject, excuses: Mapping[str, str]) -> None:
    import pytest

    verdict = apply_law(law, subject, excuses)
    if verdict.status == "failed":
        raise verdict.fault or LawError(verdict.detail)
    if verdict.status == "excused":
        pytest.xfail(verdict.detail)
    if verdict.status == "skipped":
        pytest.skip(verdict.detail)
