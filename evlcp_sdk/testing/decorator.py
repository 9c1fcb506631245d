"""The laws as tests of pytest."""

from collections.abc import Callable, Mapping
from typing import Any

from evlcp_sdk.link.resolve import Link
from evlcp_sdk.testing.exercises import subject_of
from evlcp_sdk.testing.law import InapplicableLawError, Law, LawError, Subject
from evlcp_sdk.testing.suite import checked_excuses, laws_of

__all__ = ["conformance"]


def conformance(
    role: str, *algorithms: Any, excuses: Mapping[str, str] | None = None, link: Link | None = None
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Make a test of pytest one test per law (and algorithm); its argument `check` holds the law.

    Args:
        role: The role that the algorithms fill.
        algorithms: The algorithms, with the parameters to be tested.
        excuses: Law to the reason why it is known to be broken: a strict expected failure.
        link: What the rest of the link is; None for the default.

    Raises:
        ConfigError: There is no such role or law, or an excuse has no reason.

    ```python
    @conformance("ranging", LineRanging(), LineRanging(min_clusters=4))
    def test_conformance(check):
        check()
    ```
    """
    import pytest

    known = checked_excuses(role, excuses or {})
    cases = []
    for number, algorithm in enumerate(algorithms):
        suffix = f"-{number}" if len(algorithms) > 1 else ""
        subject = subject_of(role, algorithm, link)
        for law in laws_of(role):
            reason = known.get(law.name)
            marks = [pytest.mark.xfail(reason=reason, raises=LawError, strict=True)] if reason else []
            hold = _case(law, subject, reason)
            cases.append(pytest.param(hold, id=f"{type(algorithm).__name__}{suffix}-{law.name}", marks=marks))
    return pytest.mark.parametrize("check", cases)


def _case(law: Law, subject: Subject, reason: str | None) -> Callable[[], None]:
    def check() -> None:
        import pytest

        try:
            law.hold(subject)
        except InapplicableLawError as why:
            if reason is not None:
                pytest.fail(f"excused ({reason}), but the law does not apply: {why}")
            pytest.skip(str(why))

    return check
