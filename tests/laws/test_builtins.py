"""Every algorithm of the SDK keeps every law of its role."""

import pytest

from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.testing import Law, laws_of
from evlcp_sdk.testing.law import Subject, judge

REGISTRY = Registry.load()
EXCUSES: dict[tuple[str, str], dict[str, str]] = {}
"""Algorithm to the laws that it is known to break, each with its reason."""

DO_NOTHING = {("tracking", "none"), ("error-correction", "none"), ("ranging", "none")}

CASES = [
    pytest.param(entry.algorithm.role, entry.algorithm.id, law, id=f"{entry.algorithm.id}-{law.name}")
    for entry in REGISTRY.installed()
    if entry.distribution == "evlcp-sdk"
    for law in laws_of(entry.algorithm.role)
]


@pytest.mark.parametrize(("role", "id", "law"), CASES)
def test_law(role: str, id: str, law: Law) -> None:
    algorithm = REGISTRY.load_class(role, id)()
    outcome = judge(law, Subject(role, algorithm), EXCUSES.get((role, id), {}))
    if outcome.status == "skipped":
        # A law that is skipped for a reason of its own making would hide a fault.
        assert (role, id) in DO_NOTHING
        pytest.skip(outcome.detail)
    if outcome.status == "excused":
        pytest.xfail(outcome.detail)
    assert outcome.status == "ok", outcome.detail


@pytest.mark.parametrize(("role", "id"), sorted(DO_NOTHING))
def test_what_does_nothing_is_passed_over(role: str, id: str) -> None:
    """By a law of its role at least; `test_law` sees to it that nothing else is."""
    subject = Subject(role, REGISTRY.load_class(role, id)())
    assert any(judge(law, subject, {}).status == "skipped" for law in laws_of(role))


def test_excuses_name_what_is_there() -> None:
    for role, id in EXCUSES:
        assert REGISTRY.find(role, id)
