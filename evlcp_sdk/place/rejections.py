"""Why there is no position."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

REJECTION_REASONS = {
    "no-site": "no bar in view stands at a known place",
    "no-facing": "the clusters are not in line, and no site says where its LEDs face",
    "site-contradicted": "the bars' own beacons say other places or lengths than their sites",
    "too-few-clusters": "no bar shows as many clusters as a position needs",
    "heading-unknown": "one bar alone, and the camera's heading is not known",
    "gravity-unknown": "fewer than three bars, or bars in line, and gravity is not known",
    "not-determined": "no start, no end of the fit, or equations that are singular",
    "two-solutions": "two places fit the image alike",
    "end-on": "a lone bar points along the line of sight",
    "misfit": "the image does not fit the sites: another place, bar or attitude than was said",
    "uncertain": "the position is less certain than `position.max_sigma_m`, or along a curve",
}
"""Kinds of refusal, and what they mean."""

CONTRADICTIONS = frozenset({"site-contradicted", "not-determined", "misfit"})
"""Those where what is seen and what is said do not fit together; of the others, too little is known."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """One of the poses that fit.

    Attributes:
        enu_m: Position in the local axes, m, float64 (3,).
        rotation: Camera axes as columns in ENU, float64 (3, 3).
        covariance_m2: Of the position, if it is the right one, float64 (3, 3); NaN where an ellipse does not
            describe its error.
        likelihood: How likely the image is from here, against the likeliest.
    """

    enu_m: NDArray[np.float64]
    rotation: NDArray[np.float64]
    covariance_m2: NDArray[np.float64]
    likelihood: float


@dataclass(frozen=True)
class Rejection:
    """Why there is no position.

    Attributes:
        kind: One of `REJECTION_REASONS`.
        detail: The same in words, with the figures of this case.
        candidates: Of `two-solutions`, the poses that fit, the likeliest first.
        suspects: Of `misfit`, the parts of which one, if it were left out, would explain it.
    """

    kind: str
    detail: str
    candidates: tuple[Candidate, ...] = ()
    suspects: tuple[str, ...] = ()
