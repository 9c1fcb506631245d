"""Is this ready for release? `make release`: builds sdist and wheel, tries both on each Python found.

The wheel built from the sdist holds what the wheel of the checkout does, byte by byte. Each is installed
into a clean environment of each Python from 3.11 to 3.13 that is found (or of those named, e.g. 3.12); there
`evlcp --version`, `evlcp plugins` and `evlcp demo --recording` must work. Then each extra has a clean
environment of the newest of them: what it is for must name the extra before it is installed, and work after.
What was built stays in dist/.
"""

import hashlib
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import faery
import h5py
import numpy as np

import evlcp_sdk

ROOT = Path(__file__).parents[1]
MINORS = (11, 12, 13)
RECORDING = ROOT / "examples" / "recordings" / "night-50m-30kmh-cut.raw"
# What each extra is for. There may be no camera and is no scheduler of Dask: those are asked for, no more.
EXTRAS = {
    "faery": "evlcp info rec.es",
    "parquet": "evlcp receive rec.raw -o out --parquet",
    "pandas": "python -c 'import evlcp_sdk; evlcp_sdk.receive(\"rec.raw\").to_pandas()'",
    "cluster": "evlcp receive rec.raw -o out --dask tcp://127.0.0.1:9",
    "live": "evlcp live replay:rec.raw --view",
    "mcap": "evlcp receive gate.raw -o out --sites gate.site.toml --attitude gate.attitude.csv --mcap",
    "sign": "evlcp tx keygen operator.pem",
    "docs": f"python -m sphinx -q -W {ROOT / 'docs'} site",
    "notebook": f"python {ROOT / 'docs' / 'run_notebooks.py'} --check",
    "camera": "evlcp info camera:",
    "ros": "evlcp convert rec.raw -o rec.mcap",
    "hdf5": "evlcp info rec.h5",
    "mp4": "evlcp video rec.raw -o rec.mp4 --for-ms 5",
}


def contents(wheel: Path) -> dict[str, str]:
    """SHA-256 of every file in a wheel, RECORD aside."""
    with zipfile.ZipFile(wheel) as archive:
        return {
            name: hashlib.sha256(archive.read(name)).hexdigest()
            for name in archive.namelist()
            if not name.endswith("/RECORD")
        }


def attempt(*command: str | Path, cwd: Path) -> tuple[int, str]:
    """The exit code of a command, and what it prints."""
    clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run(
        command, cwd=cwd, env=clean | {"NO_COLOR": "1"}, capture_output=True, text=True, check=False
    )
    return done.returncode, done.stdout + done.stderr


def run(*command: str | Path, cwd: Path) -> str:
    """What a command prints; it must succeed."""
    code, text = attempt(*command, cwd=cwd)
    if code:
        sys.exit(f"{' '.join(map(str, command))}: exit code {code}\n{text}")
    return text


def built(out: Path) -> tuple[Path, Path]:
    """The sdist and the wheel of the checkout; the wheel from the sdist is the same."""
    build = (sys.executable, "-m", "hatchling", "build", "-t")
    for target in ("sdist", "wheel"):
        run(*build, target, "-d", out, cwd=ROOT)
    (sdist,), (wheel,) = out.glob("*.tar.gz"), out.glob("*.whl")
    with tempfile.TemporaryDirectory() as folder:
        # Python's own, without a filter, is deprecated from 3.12 on, and has none before 3.11.4.
        run("tar", "-xf", sdist, "-C", folder, cwd=ROOT)
        (unpacked,) = Path(folder).iterdir()
        run(*build, "wheel", "-d", Path(folder) / "again", cwd=unpacked)
        (again,) = (Path(folder) / "again").glob("*.whl")
        ours, theirs = contents(wheel), contents(again)
    if differ := sorted(name for name in ours.keys() | theirs.keys() if ours.get(name) != theirs.get(name)):
        sys.exit(f"the wheel from the sdist differs in {', '.join(differ[:5])}")
    return sdist, wheel


def python_of(minor: int) -> str | None:
    """A Python of a minor version that runs: on the path, or of pyenv, whose names on the path may not."""
    pyenv = sorted((Path.home() / ".pyenv" / "versions").glob(f"3.{minor}.*/bin/python"))
    for python in (shutil.which(f"python3.{minor}"), *map(str, reversed(pyenv))):
        command = (python, "-c", "import sys; print(sys.version_info[1])") if python else ("false",)
        if subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip() == str(minor):
            return python
    return None


def environment(python: str, package: Path, folder: Path) -> Path:
    """The programs of a clean environment with a package."""
    run(python, "-m", "venv", folder / "venv", cwd=folder)
    programs = folder / "venv" / "bin"
    run(programs / "python", "-m", "pip", "-q", "--disable-pip-version-check", "install", package, cwd=folder)
    return programs


def tried(python: str, package: Path) -> str:
    """What the version option prints of a package in a clean environment."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        at = environment(python, package, folder)
        version = run(at / "evlcp", "--version", cwd=folder).strip()
        run(at / "evlcp", "plugins", cwd=folder)
        run(at / "evlcp", "demo", "--recording", cwd=folder)
        run(at / "python", "-m", "pip", "check", cwd=folder)
        return version


def write_inputs(folder: Path) -> None:
    """The files that the commands of the extras read."""
    shutil.copy(RECORDING, folder / "rec.raw")
    gate = (ROOT / "examples" / "scenes" / "gate.toml", "--set", "duration_s=0.2", "-o", "gate.raw")
    run(Path(sys.executable).parent / "evlcp", "simulate", *gate, cwd=folder)
    events = next(iter(evlcp_sdk.open(RECORDING).chunks()))
    records = np.zeros(events.t_us.size, faery.EVENTS_DTYPE)
    columns = {"t": events.t_us, "x": events.x, "y": events.y, "p": events.p}
    with h5py.File(folder / "rec.h5", "w") as file:
        for name, column in columns.items():
            file[f"events/{name}"] = column
            records["on" if name == "p" else name] = column
    faery.events_stream_from_array(records, (1280, 720)).to_file(folder / "rec.es")


def try_extra(python: str, wheel: Path, extra: str) -> str:
    """How many packages an extra brings, alone, with which its command works."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_inputs(folder)
        at = environment(python, wheel, folder)
        program, *arguments = shlex.split(EXTRAS[extra])
        pip = (at / "python", "-m", "pip", "--disable-pip-version-check")
        before = run(*pip, "freeze", cwd=folder).splitlines()
        code, text = attempt(at / program, *arguments, cwd=folder)
        named = f"evlcp-sdk[{extra}]"
        if not code or not (named in text or "No module named" in text):
            sys.exit(f"{EXTRAS[extra]}, without {named}: exit code {code}, expected its name\n{text}")
        run(*pip, "-q", "install", f"{wheel}[{extra}]", cwd=folder)
        run(*pip, "check", cwd=folder)
        code, text = attempt(at / program, *arguments, cwd=folder)
        if named in text or (code and extra not in ("camera", "cluster")):
            sys.exit(f"{EXTRAS[extra]}, with {named}: exit code {code}\n{text}")
        return f"{len(run(*pip, 'freeze', cwd=folder).splitlines()) - len(before)} packages more"


def main() -> None:
    """Print what was built and where it works."""
    out = ROOT / "dist"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    packages = built(out)
    for path in packages:
        report(f"{path.name}: {path.stat().st_size / 1e6:.1f} MB")
    pythons = [int(name.removeprefix("3.")) for name in sys.argv[1:]] or MINORS
    found = {minor: python for minor in pythons if (python := python_of(minor))}
    for minor in pythons:
        for path in packages:
            what = tried(found[minor], path) if minor in found else "not found, not tried"
            report(f"Python 3.{minor}, {path.name}: {what}")
    for extra in EXTRAS if found else ():
        newest = max(found)
        report(f"Python 3.{newest}, extra {extra}: {try_extra(found[newest], packages[1], extra)}")


def report(text: str) -> None:
    """Print a line at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
