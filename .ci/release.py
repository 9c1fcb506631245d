"""Is this ready for release? `make release`: builds sdist and wheel, tries the wheel on each Python found.

The wheel built from the sdist holds what the wheel of the checkout does, byte by byte. It is installed
into a clean environment of each Python from 3.11 to 3.13 that is found (or of those named, e.g. 3.12); there
`evlcp --version`, `evlcp plugins` and `evlcp demo --recording` must work. What was built stays in dist/.
"""

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
MINORS = (11, 12, 13)


def contents(wheel: Path) -> dict[str, str]:
    """SHA-256 of every file in a wheel, RECORD aside."""
    with zipfile.ZipFile(wheel) as archive:
        return {
            name: hashlib.sha256(archive.read(name)).hexdigest()
            for name in archive.namelist()
            if not name.endswith("/RECORD")
        }


def run(*command: str | Path, cwd: Path) -> str:
    """What a command prints; it must succeed."""
    clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run(
        command, cwd=cwd, env=clean | {"NO_COLOR": "1"}, capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(f"{' '.join(map(str, command))}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


def built(out: Path) -> tuple[Path, Path]:
    """The sdist and the wheel of the checkout; the wheel from the sdist is the same."""
    build = (sys.executable, "-m", "hatchling", "build", "-t")
    for target in ("sdist", "wheel"):
        run(*build, target, "-d", out, cwd=ROOT)
    (sdist,), (wheel,) = out.glob("*.tar.gz"), out.glob("*.whl")
    with tempfile.TemporaryDirectory() as folder:
        shutil.unpack_archive(sdist, folder, filter="data")
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


def tried(python: str, wheel: Path) -> str:
    """What the version option prints of the wheel in a clean environment."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run(python, "-m", "venv", folder / "venv", cwd=folder)
        at = folder / "venv" / "bin"
        run(at / "python", "-m", "pip", "-q", "--disable-pip-version-check", "install", wheel, cwd=folder)
        version = run(at / "evlcp", "--version", cwd=folder).strip()
        run(at / "evlcp", "plugins", cwd=folder)
        run(at / "evlcp", "demo", "--recording", cwd=folder)
        run(at / "python", "-m", "pip", "check", cwd=folder)
        return version


def main() -> None:
    """Print what was built and where it works."""
    out = ROOT / "dist"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    for path in built(out):
        sys.stdout.write(f"{path.name}: {path.stat().st_size / 1e6:.1f} MB\n")
    (wheel,) = out.glob("*.whl")
    for minor in [int(name.removeprefix("3.")) for name in sys.argv[1:]] or MINORS:
        python = python_of(minor)
        what = tried(python, wheel) if python else "not found, not tried"
        sys.stdout.write(f"Python 3.{minor}: {what}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
