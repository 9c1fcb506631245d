"""Laws that every algorithm must keep, and ideal recordings to test with; see `docs/conformance.md`."""

from evlcp_sdk.testing.law import InapplicableLawError, Law, LawError, Verdict
from evlcp_sdk.testing.recordings import IdealBar, ideal_events, random_symbols
from evlcp_sdk.testing.suite import check, conformance, laws_of
from evlcp_sdk.testing.views import ideal_frame, ideal_presence, ideal_soft, ideal_sums, ideal_view

__all__ = [
    "IdealBar",
    "InapplicableLawError",
    "Law",
    "LawError",
    "Verdict",
    "check",
    "conformance",
    "ideal_events",
    "ideal_frame",
    "ideal_presence",
    "ideal_soft",
    "ideal_sums",
    "ideal_view",
    "laws_of",
    "random_symbols",
]
