"""Every algorithm of the SDK keeps every law of its role."""

import sys

import pytest
from numba import types

from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.testing import laws_of
from evlcp_sdk.testing.law import Subject, judge

REGISTRY = Registry.load()
DO_NOTHING = {
    *(("tracking", "none"), ("error-correction", "none"), ("ranging", "none")),
    *(("detection", "rhythm"), ("framing", "packets")),
}
"""What the receiver does by itself, of the last two."""

CASES = [
    pytest.param(entry.algorithm.role, entry.algorithm.id, law, id=f"{entry.algorithm.id}-{law.name}")
    for entry in REGISTRY.installed()
    if entry.distribution == "evlcp-sdk"
    for law in laws_of(entry.algorithm.role)
]


def of_odd_arrays():
    """Versions of a kernel beside another one, for arrays that are read-only, or whose elements lie apart."""
    return {
        (module, name, str(args))
        for module in [name for name in sys.modules if name.endswith("_kernels")]
        for name, kernel in list(vars(sys.modules[module]).items())
        for signatures in [getattr(kernel, "signatures", ())]
        for args in signatures
        if len(signatures) > 1
        and any(isinstance(arg, types.Array) and not (arg.mutable and arg.layout == "C") for arg in args)
    }


@pytest.mark.parametrize(("role", "id", "law"), CASES)
def test_law(role, id, law):
    algorithm = REGISTRY.load_class(role, id)()
    before = of_odd_arrays()
    outcome = judge(law, Subject(role, algorithm), {})
    # It would take seconds, at the first of them in a recording.
    assert not of_odd_arrays() - before, "kernels compiled once more for how arrays lie in memory"
    if outcome.status == "skipped":
        # A law that is skipped for a reason of its own making would hide a fault.
        assert (role, id) in DO_NOTHING
        pytest.skip(outcome.detail)
    assert outcome.status == "ok", outcome.detail


@pytest.mark.parametrize(("role", "id"), sorted(DO_NOTHING))
def test_what_does_nothing_is_passed_over(role, id):
    """By a law of its role at least; `test_law` sees to it that nothing else is."""
    subject = Subject(role, REGISTRY.load_class(role, id)())
    assert any(judge(law, subject, {}).status == "skipped" for law in laws_of(role))
