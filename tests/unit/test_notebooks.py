"""The notebooks of the docs run in Jupyter's kernel and print what the site shows."""

from importlib.util import find_spec
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "docs" / "notebooks"

pytestmark = pytest.mark.skipif(
    any(find_spec(name) is None for name in ("ipykernel", "nbclient")),
    reason="the extra notebook is not installed",
)


@pytest.mark.filterwarnings("ignore")  # of the event loop that talks to the kernel
@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_prints_what_it_shows(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(FOLDER.parent))
    import nbformat
    from run_notebooks import executed, said

    assert said(executed(path)) == said(nbformat.read(path, as_version=4))
