"""The notebooks of the docs run and print what the site shows."""

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import pytest

DOCS = Path(__file__).parents[2] / "docs"
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_prints_what_it_shows(path, monkeypatch, capsys) -> None:
    """In this process: to start a kernel takes longer than most of them."""
    pyplot = pytest.importorskip("matplotlib.pyplot", reason="the extra notebook is not installed")
    pyplot.switch_backend("agg")
    main = ModuleType("__main__")
    monkeypatch.setitem(sys.modules, "__main__", main)
    monkeypatch.chdir(path.parent)
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), path.name, "exec"), vars(main))
            shown = ["".join(out["text"]) for out in cell["outputs"] if out["output_type"] == "stream"]
            assert capsys.readouterr().out == "".join(shown)
    pyplot.close("all")


@pytest.mark.skipif(
    any(find_spec(name) is None for name in ("ipykernel", "nbclient")),
    reason="the extra notebook is not installed",
)
def test_jupyter_runs_a_notebook() -> None:
    # In a process of its own, which closes what the client of a kernel leaves open.
    command = [sys.executable, DOCS / "run_notebooks.py", "--check", "first-recording"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
