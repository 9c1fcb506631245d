"""What a law is, and how an algorithm is held against one."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.testing.trees import difference

if TYPE_CHECKING:
    from evlcp_sdk.link.resolve import Link

Status = Literal["ok", "failed", "skipped", "excused"]
"""`excused`: fails, as the author declared it would, with a reason."""


class LawError(AssertionError):
    """An algorithm breaks a law; the message says what was expected."""


class InapplicableLawError(Exception):
    """A law does not concern an algorithm; the message is the reason."""


@dataclass(frozen=True)
class Subject:
    """An algorithm under test.

    Attributes:
        role: The role that it fills.
        algorithm: The algorithm, with the parameters to be tested.
        link: What the rest of the link is; None for the default.
        id: What messages call it; None for the name of its class.
    """

    role: str
    algorithm: Any
    link: "Link | None" = None
    id: str | None = None


@dataclass(frozen=True)
class Law:
    """What every algorithm of a role must do.

    Attributes:
        name: Short name, unique within a role.
        says: The law in one line.
        test: Raises `LawError` where the subject breaks it, `InapplicableLawError` where it does not concern
            the subject.
    """

    name: str
    says: str
    test: Callable[[Subject], None]

    def hold(self, subject: Subject) -> None:
        """Hold a subject against the law.

        Raises:
            LawError: It breaks the law; any exception of the algorithm counts as that.
            InapplicableLawError: The law does not concern it.
        """
        try:
            self.test(subject)
        except (LawError, InapplicableLawError):
            raise
        except Exception as fault:
            raise LawError(f"expected no exception, got {type(fault).__name__}: {fault}") from fault


def law(name: str, says: str) -> Callable[[Callable[[Subject], None]], Law]:
    """Make a test of a subject a law."""
    return lambda test: Law(name, says, test)


@dataclass(frozen=True)
class Verdict:
    """How a law was kept.

    Attributes:
        law: The law.
        status: Whether it was kept.
        detail: What was expected and found, or why the law was passed over; empty if it was kept.
        fault: How it was broken, with where that was in the algorithm; None otherwise.
    """

    law: Law
    status: Status
    detail: str = ""
    fault: LawError | None = field(default=None, compare=False)


def expect(holds: object, what: str) -> None:
    """Raise `LawError` with `what` was expected unless `holds`."""
    if not holds:
        raise LawError(f"expected {what}")


def expect_same(got: Any, wanted: Any, what: str, tolerance: float = 0.0, name: str = "result") -> None:
    """Raise `LawError` with `what` was expected, and the first difference, unless two values are equal."""
    differs = difference(got, wanted, tolerance, name)
    expect(differs is None, f"{what}; {differs}")


def compile_or_skip(make: Callable[[], Any]) -> Any:
    """What `make` compiles.

    Raises:
        InapplicableLawError: The algorithm refuses the test's bar or codes; that alone is for the law
            `compiles` to judge.
    """
    try:
        return make()
    except ConfigError as refused:
        raise InapplicableLawError(f"refused: {refused}") from refused


def judge(law: Law, subject: Subject, excuses: Mapping[str, str]) -> Verdict:
    """Hold a subject against a law; an excuse must be needed, or it is a failure itself."""
    reason = excuses.get(law.name)
    try:
        law.hold(subject)
    except InapplicableLawError as why:
        if reason is not None:
            return Verdict(law, "failed", f"excused ({reason}), but the law does not apply: {why}")
        return Verdict(law, "skipped", str(why))
    except LawError as fault:
        if reason is not None:
            return Verdict(law, "excused", reason)
        return Verdict(law, "failed", str(fault), fault)
    if reason is not None:
        return Verdict(law, "failed", f"excused ({reason}), but it holds: drop the excuse")
    return Verdict(law, "ok")
