"""Every reader, with damaged files: it reads them or says in lines what is wrong, and nothing else.

`make test` draws the same files every time, `make fuzz` new ones, as many as it is told.
"""

import os
import random
import subprocess
import sys
import warnings
import zlib
from pathlib import Path

import pytest

from evlcp_sdk.errors import EvlcpError
from evlcp_sdk.study.collect import collect_results
from evlcp_sdk.study.jobs import Inline
from evlcp_sdk.study.store import Store
from tests.fuzz.corpus import kinds
from tests.fuzz.mutate import damage
from tests.unit.study.fake import fake_plan, run_fake

NAMES = (
    *("EVT3", "EVT2", "EVT21", "NPZ", "CSV", "CSV in gzip", "NPY", "HDF5", "MAT 7.3", "MAT", "MCAP", "db3"),
    *("NMEA", "update", "truth", "frames.csv", "summary.json", "poses", "attitude", "sites", "link", "scene"),
    *("campaign", "results", "symbols", "masks", "inventory"),
)

ROUNDS = {"campaign": 10, "EVT3": 150, "EVT2": 150, "EVT21": 150}
"""Damaged files of a kind; 40 of others. `make fuzz` reads more."""


def store_of(folder):
    """A finished campaign's results file."""
    path = folder / "results.sqlite"
    with Store(path, create=True) as store:
        collect_results(fake_plan(scenes=2, seeds=2), store, Inline(), run_fake)
    return path.read_bytes()


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    folder = tmp_path_factory.mktemp("corpus")
    return {kind.name: kind for kind in kinds(folder, store_of(folder))}


def is_refused(kind, data, folder):
    """Read a file with these bytes; whether it was refused, in lines that name it."""
    path = folder / kind.file
    path.write_bytes(data)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            kind.read(path)
    except EvlcpError as fault:
        lines = str(fault).splitlines()
        assert lines, "an empty message"
        assert path.name in lines[0] or str(folder) in lines[0], f"does not name the file: {lines[0]}"
        assert max(map(len, lines)) < 2000, f"a line of {max(map(len, lines))} characters"
        return True
    return False


def test_the_corpus_is_good(corpus, tmp_path):
    assert tuple(corpus) == NAMES
    for kind in corpus.values():
        assert not is_refused(kind, kind.data, tmp_path), kind.name


@pytest.mark.parametrize("name", NAMES)
def test_damaged_files(corpus, name, tmp_path):
    kind = corpus[name]
    rng = random.Random(zlib.crc32(name.encode()))
    rounds = ROUNDS.get(name, 40)
    faults = sum(is_refused(kind, damage(kind.data, rng), tmp_path) for _ in range(rounds))
    # Accidents that change nothing that matters are read, and others must be seen.
    assert faults > 0


def test_no_kernel_reads_or_writes_beside_its_arrays(corpus, tmp_path):
    """The same files in a process whose kernels check every index."""
    code = (
        "import pathlib, random, sys; from tests.fuzz.corpus import read_recording\n"
        "from tests.fuzz.mutate import damage; from evlcp_sdk.errors import EvlcpError\n"
        "path, *good = (pathlib.Path(a) for a in sys.argv[1:])\n"
        "rng = random.Random(5)\n"
        "for n in range(60):\n"
        "    path.write_bytes(damage(good[n % 3].read_bytes(), rng))\n"
        "    try: read_recording(path)\n"
        "    except EvlcpError: pass\n"
    )
    good = [tmp_path / f"{name}.raw" for name in ("EVT3", "EVT2", "EVT21")]
    for path in good:
        path.write_bytes(corpus[path.stem].data)
    # What is compiled is not kept, and need not be fast.
    numba = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_OPT": "0", "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "a.raw", *good],
        env=os.environ | numba,
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
