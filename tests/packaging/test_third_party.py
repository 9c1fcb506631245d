"""A stranger's package and ours, as wheels in a fresh environment: found, checked, used, gone again."""

import json
import os
import runpy
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "third_party_plugin"
FORMATS = ROOT / "examples" / "third_party_formats"
RECORDING = ROOT / "examples" / "recordings" / "night-50m-30kmh-cut.raw"


class Environment:
    """A fresh virtual environment that borrows all but the SDK from the one that runs the tests."""

    def __init__(self, folder):
        self.folder = folder
        self.bin = folder / "venv" / "bin"
        venv.create(folder / "venv", with_pip=False, symlinks=True)
        borrowed = folder / "borrowed"
        borrowed.mkdir()
        for entry in Path(sysconfig.get_path("purelib")).iterdir():
            # Neither the SDK's metadata nor the file that puts its folders on the path.
            if "evlcp" not in entry.name and entry.suffix != ".pth":
                (borrowed / entry.name).symlink_to(entry)
        version = f"python{sys.version_info.major}.{sys.version_info.minor}"
        self.site = folder / "venv" / "lib" / version / "site-packages"
        (self.site / "borrowed.pth").write_text(f"{borrowed}\n")

    def run(self, *command, code=0, cwd=None):
        """What a command of the environment says; it must end with `code`.

        That it compiles kernels, which is said on stderr, is left out.
        """
        clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
        done = subprocess.run(
            [self.bin / command[0], *command[1:]],
            cwd=cwd or self.folder,
            env=clean | {"NO_COLOR": "1"},
            capture_output=True,
            text=True,
            check=False,
            timeout=300,
        )
        assert done.returncode == code, f"{command}\n{done.stdout}\n{done.stderr}"
        reported = [line for line in done.stderr.splitlines(keepends=True) if "compiling kernels" not in line]
        return done.stdout + "".join(reported)

    def build(self, project):
        """The wheel of a project."""
        wheels = self.folder / "wheels"
        before = set(wheels.glob("*.whl"))
        self.pip("wheel", "--no-build-isolation", "--wheel-dir", wheels, project)
        (wheel,) = set(wheels.glob("*.whl")) - before
        return wheel

    def pip(self, verb, *rest):
        """Run pip, which must not ask any index."""
        only = ("--no-deps", "--no-index") if verb != "uninstall" else ("-y",)
        return self.run("python", "-m", "pip", "-q", "--disable-pip-version-check", verb, *only, *rest)

    def lend_kernels(self):
        """Give it what is compiled already of modules that are the same: it takes that, and adds to it."""
        for source in ROOT.glob("*/**/_kernels.py"):
            folder = source.relative_to(ROOT)
            folder = folder.relative_to("plugins") if folder.parts[0] == "plugins" else folder
            installed = self.site / folder
            if installed.is_file() and installed.read_bytes() == source.read_bytes():
                # numba takes a kernel for that of a file by the file's time and size.
                shutil.copystat(source, installed)
                for kernel in source.parent.glob("__pycache__/_kernels.*.nb?"):
                    (installed.parent / "__pycache__").mkdir(exist_ok=True)
                    shutil.copy(kernel, installed.parent / "__pycache__")

    def plugins(self):
        """(role, id) of each algorithm to its distribution and version."""
        rows = json.loads(self.run("evlcp", "plugins", "--json"))["algorithms"]
        return {(r["role"], r["id"]): (r["distribution"], r["version"]) for r in rows}


def build_wheel(folder):
    """The SDK's wheel; that from its sdist is the same."""
    folder.mkdir()
    release = runpy.run_path(str(ROOT / ".ci" / "release.py"))
    sdist, wheel = release["built"](folder)
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert sdist.name == f"evlcp_sdk-{version}.tar.gz"
    inside = release["contents"](wheel)
    assert {"evlcp_sdk/py.typed", "evlcp_sdk/data/demo.toml", "evlcp_uart/framing.py"} <= inside.keys()
    assert not [name for name in inside if name.startswith(("tests/", "docs/", "examples/"))]
    return Path(wheel)


@pytest.fixture
def environment(tmp_path):
    """The environment with both wheels."""
    made = Environment(tmp_path)
    made.pip("install", build_wheel(tmp_path / "dist"), made.build(EXAMPLE), made.build(FORMATS))
    made.lend_kernels()
    yield made
    # Borrowed packages are links: only these go.
    shutil.rmtree(made.folder)


def test_a_strangers_package_is_as_good_as_a_built_in(environment):
    """One test: to build the wheels and install them takes most of its time."""
    modules = ("evlcp_sdk", "evlcp_wh", "firmware_host", "evlcp_robust")
    code = f"import {', '.join(modules)}; print(*(m.__file__ for m in ({', '.join(modules)})), sep='\\n')"
    paths = environment.run("python", "-c", code).splitlines()
    assert len(paths) == len(modules)
    assert all(Path(path).is_relative_to(environment.site) for path in paths)
    plugins = environment.plugins()
    assert plugins["ranging", "poc"][0] == "evlcp-sdk"
    assert plugins["ranging", "median-pairs"] == ("evlcp-robust", "1.2.0")
    assert plugins["decoding", "majority"] == ("evlcp-robust", "1.2.0")
    # Its algorithm is checked, and its own tests pass.
    result = json.loads(environment.run("evlcp", "check", "ranging", "median-pairs", "--json"))
    assert (result["distribution"], result["version"]) == ("evlcp-robust", "1.2.0")
    assert {law["status"] for law in result["laws"]} == {"ok"}
    for folder in (EXAMPLE, FORMATS):
        reported = environment.run("python", "-m", "pytest", "-q", "-p", "no:cacheprovider", cwd=folder)
        assert " passed" in reported
        assert "skipped" not in reported
    # Its algorithms and its format are used.
    out = environment.folder / "out"
    sets = ("ranging.id=median-pairs", "ranging.min_spacing=0.4", "decoding.id=majority")
    options = ("--sink", "distance-lines", *(x for s in sets for x in ("--set", s)))
    environment.run("evlcp", "receive", RECORDING, "-o", out, *options)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["versions"]["evlcp-robust"] == "1.2.0"
    given = summary["configuration"]
    assert given["ranging"] == {"id": "median-pairs", "min_spacing": 0.4, "min_clusters": 5}
    assert given["decoding"]["id"] == "majority"
    lines = (out / "distances.line").read_text().splitlines()
    assert len(lines) == summary["transmitters"][0]["frames_ranged"] > 10
    assert summary["sinks"] == {"distance-lines": {"lines": len(lines)}}
    truth = RECORDING.with_suffix(".truth.json")
    (bar,) = json.loads(environment.run("evlcp", "score", out, truth, "--json"))["bars"]
    assert bar["frames_found"] == bar["frames_sent"] > 10
    assert bar["ber"] < 0.02
    assert bar["rmse_m"] < 0.5
    # Uninstalled they are gone.
    environment.pip("uninstall", "evlcp-roadside", "evlcp-robust")
    none = environment.folder / "none"
    reported = environment.run("evlcp", "receive", RECORDING, "-o", none, "--sink", "distance-lines", code=2)
    assert "no sink named 'distance-lines'" in reported
    assert not none.exists()
    assert ("ranging", "median-pairs") not in environment.plugins()
    reported = environment.run("evlcp", "config", "--set", "ranging.id=median-pairs", code=2)
    assert "no ranging algorithm named 'median-pairs'" in reported
