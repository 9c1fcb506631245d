"""The notebooks of the docs run in Jupyter's kernel and print what the site shows."""

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"

pytestmark = pytest.mark.skipif(
    any(find_spec(name) is None for name in ("ipykernel", "nbclient")),
    reason="the extra notebook is not installed",
)


@pytest.mark.parametrize("name", sorted(path.stem for path in (DOCS / "notebooks").glob("*.ipynb")))
def test_a_notebook_prints_what_it_shows(name: str) -> None:
    # In a process of its own, which closes what the client of a kernel leaves open.
    command = [sys.executable, DOCS / "run_notebooks.py", "--check", name]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
