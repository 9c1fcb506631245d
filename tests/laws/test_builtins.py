"""Every algorithm of the SDK keeps every law of its role."""

from pathlib import Path

import pytest

from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.testing import laws_of
from evlcp_sdk.testing.law import Subject, apply_law

REGISTRY = Registry.load()
DO_NOTHING = {
    *(("tracking", "none"), ("error-correction", "none"), ("ranging", "none")),
    *(("detection", "rhythm"), ("framing", "packets")),
}
"""What the receiver does by itself, of the last two."""

CASES = [
    pytest.param(entry.algorithm.role, entry.algorithm.id, law, id=f"{entry.algorithm.id}-{law.name}")
    for entry in REGISTRY.list_algorithms()
    if entry.distribution == "evlcp-sdk"
    for law in laws_of(entry.algorithm.role)
]


@pytest.mark.parametrize(("role", "id", "law"), CASES)
def test_law(role, id, law):
    algorithm = REGISTRY.load_class(role, id)()
    outcome = apply_law(law, Subject(role, algorithm), {})
    if outcome.status == "skipped":
        # A law that is skipped for a reason of its own making would hide a fault.
        assert (role, id) in DO_NOTHING
        pytest.skip(outcome.detail)
    assert outcome.status == "ok", outcome.detail


@pytest.mark.parametrize(
    "path", sorted((Path(__file__).parents[2] / "examples" / "links").glob("*.toml")), ids=lambda p: p.stem
)
def test_the_time_of_other_sensors_is_found(path):
    link = load_link(path)
    subject = Subject("synchronization", link.algorithm("synchronization"), link)
    laws = {law.name: law for law in laws_of("synchronization")}
    for name in ("finds-time", "clean-link"):
        outcome = apply_law(laws[name], subject, {})
        assert outcome.status == "ok", outcome.detail
