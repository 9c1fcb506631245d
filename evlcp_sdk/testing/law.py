"""Laws of algorithms, and how they are tested."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.testing.trees import find_difference

if TYPE_CHECKING:
    from evlcp_sdk.link.resolve import Link

Status = Literal["ok", "failed", "skipped", "excused"]
"""`excused`: fails, as its author declared, with a reason."""


class LawError(AssertionError):
    """An algorithm breaks a law; the message has what was expected."""


class InapplicableLawError(Exception):
    """A law does not concern an algorithm; the message is the reason."""


@dataclass(frozen=True)
class Subject:
    """An algorithm under test.

    Attributes:
        role: Its role.
        algorithm: The algorithm, with the parameters to be tested.
        link: The rest of the link; None for the default.
        id: Its name in messages; None for the name of its class.
    """

    role: str
    algorithm: Any
    link: "Link | None" = None
    id: str | None = None


@dataclass(frozen=True)
class Law:
    """A law that every algorithm of a role must keep.

    Attributes:
        name: Short name, unique within a role.
        statement: The law in one line.
        test: Raises `LawError` if a subject breaks it, `InapplicableLawError` if it does not concern the
            subject.
    """

    name: str
    statement: str
    test: Callable[[Subject], None]

    def apply(self, subject: Subject) -> None:
        """Test a subject.

        Raises:
            LawError: It breaks the law; any exception of the algorithm counts as that.
            InapplicableLawError: The law does not concern it.
        """
        try:
            self.test(subject)
        except (LawError, InapplicableLawError):
            raise
        except (Exception, SystemExit) as fault:
            raise LawError(f"expected no exception, got {type(fault).__name__}: {fault}") from fault


def law(name: str, statement: str) -> Callable[[Callable[[Subject], None]], Law]:
    """Return the decorator that makes a test of a subject a law."""
    return lambda test: Law(name, statement, test)


@dataclass(frozen=True)
class Verdict:
    """The result of testing a law.

    Attributes:
        law: The law.
        status: Whether it was kept.
        detail: What was expected and found, or why the law was skipped; empty if it was kept.
        fault: The error, with its place in the algorithm, if the law was broken.
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
    differs = find_difference(got, wanted, tolerance, name)
    expect(differs is None, f"{what}; {differs}")


def compile_or_skip(make: Callable[[], Any]) -> Any:
    """Compile an algorithm by `make`.

    Raises:
        InapplicableLawError: The algorithm refuses the test's bar or codes, which only the law `compiles`
            tests.
    """
    try:
        return make()
    except ConfigError as refused:
        raise InapplicableLawError(f"refused: {refused}") from refused


def apply_law(law: Law, subject: Subject, excuses: Mapping[str, str]) -> Verdict:
    """Test a subject by a law; an excuse that is not needed is a failure."""
    reason = excuses.get(law.name)
    try:
        law.apply(subject)
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
