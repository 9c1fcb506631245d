"""Run the notebooks and keep what they show: `python docs/run_notebooks.py [--check] [NAME ...]`.

With `--check` nothing is kept: a cell that prints something else than it shows ends it with 1.
"""

import os
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).resolve().parent / "notebooks"


def execute(path: Path) -> nbformat.NotebookNode:
    """A notebook with what its cells show now; times and numbers of runs are left out.

    Raises:
        CellExecutionError: A cell fails.
    """
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(
        notebook,
        kernel_name="python3",
        timeout=120,
        record_timing=False,
        # Its warning that others on this machine could listen.
        extra_arguments=["--IPKernelApp.log_level=ERROR"],
    )
    with TemporaryDirectory() as scratch:
        settings = {"MPLBACKEND": "module://matplotlib_inline.backend_inline", "IPYTHONDIR": scratch}
        client.execute(cwd=str(path.parent), env=os.environ | settings)
    for cell in notebook.cells:
        cell.metadata.clear()
        if cell.cell_type == "code":
            cell.execution_count = None
            for output in cell.outputs:
                if "execution_count" in output:
                    output.execution_count = None
    return notebook


def printed_texts(notebook: nbformat.NotebookNode) -> list[str]:
    """What the cells of a notebook print, cell by cell."""
    return [
        "".join(output.text for output in cell.outputs if output.output_type == "stream")
        for cell in notebook.cells
        if cell.cell_type == "code"
    ]


def main(names: list[str]) -> None:
    """Run the notebooks of these names, or all."""
    check = "--check" in names
    wanted = [name for name in names if name != "--check"]
    for name in wanted or sorted(path.stem for path in FOLDER.glob("*.ipynb")):
        path = FOLDER / f"{name}.ipynb"
        now, before = execute(path), nbformat.read(path, as_version=4)
        if not check:
            nbformat.write(now, path)
            continue
        for shown, printed in zip(printed_texts(before), printed_texts(now), strict=True):
            if shown != printed:
                sys.exit(f"{path.name} shows:\n{shown}\nand prints:\n{printed}\n`make notebooks` keeps that")


if __name__ == "__main__":
    main(sys.argv[1:])
