"""What the NEES of a recording is by chance, as benchmarks/elsewhere.py has it."""

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

FOLDER = Path(__file__).parents[3] / "benchmarks"


@pytest.fixture(scope="module")
def elsewhere() -> Any:
    sys.path.insert(0, str(FOLDER))
    try:
        spec = importlib.util.spec_from_file_location("benchmarks_elsewhere", FOLDER / "elsewhere.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules["benchmarks_elsewhere"] = module
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(FOLDER))
    return module


@pytest.mark.parametrize(("errors", "share"), [(1, 0.322), (10, 0.862), (24, 0.977)])
def test_how_often_a_recording_of_true_sigmas_is_within_bounds(
    elsewhere: Any, errors: int, share: float
) -> None:
    rng = np.random.default_rng(errors)
    nees = (rng.standard_normal((100_000, errors)) ** 2).mean(1)
    assert elsewhere.within(errors) == pytest.approx(share, abs=1e-3)
    assert ((nees >= 0.5) & (nees <= 2)).mean() == pytest.approx(share, abs=5e-3)


def test_the_spread_says_how_many_errors_are_independent(elsewhere: Any) -> None:
    rng = np.random.default_rng(0)
    # Frames of a recording come in eight blocks of one error each, whose sigmas are a tenth too large.
    nees = (rng.standard_normal((4000, 8)) ** 2).mean(1) / 1.21
    words = elsewhere.honest([*nees, np.nan])
    assert words.startswith("mean 0.8")
    assert "of 4000," in words
    assert float(words.split("spread as of ")[1].split()[0]) == pytest.approx(8, rel=0.1)
    seen, due = (float(part.split("%")[0].split()[-1]) for part in words.split("; ")[1].split(", "))
    assert seen == pytest.approx(due, abs=2)
