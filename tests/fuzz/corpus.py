"""A small good file of every kind that is read, and its reader."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader

from evlcp_sdk.io import open_source
from evlcp_sdk.io.open import open_writer
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.place.calibration import read_poses
from evlcp_sdk.place.gnss import checksum, read_nmea
from evlcp_sdk.results.folder import read_summary
from evlcp_sdk.scene.attitude import AttitudeLog
from evlcp_sdk.scene.sites import load_sites
from evlcp_sdk.sim.scene import load_scene
from evlcp_sdk.sim.truth import read_truth
from evlcp_sdk.study.frames import read_frames
from evlcp_sdk.study.store import Store
from evlcp_sdk.study.summary import summarize
from evlcp_sdk.study.task import plan_campaign
from evlcp_sdk.values import Events, Triggers
from firmware_host.board.bank import read_masks
from firmware_host.board.fleet import read_inventory
from firmware_host.board.symbols import read_symbols
from firmware_host.board.update import UpdatePackage
from tests.unit.io.writers import write_hdf5, write_mat, write_mat_73, write_npy, write_sqlite

EXAMPLES = Path(__file__).parents[2] / "examples"
WIDTH, HEIGHT = 64, 48


@dataclass(frozen=True)
class Kind:
    """A kind of file: the name that it is read under, a good one, and what raises for what is wrong in it."""

    name: str
    file: str
    data: bytes
    read: Callable[[Path], Any]


def some_events(n=1500):
    rng = np.random.default_rng(1)
    times = 100 + rng.integers(0, 40, n).cumsum()
    return Events.of(times, *(rng.integers(0, most, n) for most in (WIDTH, HEIGHT, 2)))


def read_recording(path):
    """Read all events and triggers of a recording; they are what they claim to be."""
    with open_source(path) as source:
        width, height = source.width, source.height
        n = 0
        for events in source.chunks():
            n += len(events)
            assert events.p.max(initial=0) <= 1
            assert width is None or events.x.max(initial=0) < 2**16
            assert height is None or len(events.t_us) == len(events.y)
    # A word of EVT3 gives twelve events at the most, a row of a table one.
    assert n <= 12 * max(path.stat().st_size, 1) or path.suffix == ".npz"
    return n


def _recording(folder, name, format=None):
    path, events = folder / name, some_events()
    triggers = Triggers.of(events.t_us[::300], [0] * 5, [1, 0, 1, 0, 1])
    with open_writer(path, WIDTH, HEIGHT, format) as writer:
        # A table of text has no place for triggers.
        writer.write(events, None if ".csv" in name else triggers)
    return path.read_bytes()


def _columns():
    events = some_events()
    return {"t": events.t_us, "x": events.x, "y": events.y, "p": events.p}


def write_file(path, write, *what):
    write(path, *what)
    return path.read_bytes()


def _db3(folder):
    """The messages of a bag of MCAP in one of SQLite."""
    path = folder / "messages.mcap"
    _recording(folder, path.name)
    with path.open("rb") as file:
        messages = [message.data for _, _, message in make_reader(file).iter_messages()]
    return write_file(folder / "a.db3", write_sqlite, messages, range(len(messages)))


def summary_file(path):
    with Store(path) as store:
        summarize(store)


UPDATE = UpdatePackage("stm32f405-8mhz", {1: bytes(range(200)), 2: bytes(range(100, 250))})
NMEA = b"".join(
    f"${line}*{checksum(line)}\r\n".encode()
    for line in (
        "GNGGA,120000.00,3506.0000,N,13712.0000,E,4,12,0.6,54.5,M,37.0,M,1.0,0000",
        "GNGST,120000.00,0.5,0.02,0.01,45.0,0.02,0.02,0.04",
        "GNGGA,120001.00,3506.0010,N,13712.0010,E,4,12,0.6,54.5,M,37.0,M,1.0,0000",
    )
)
FRAMES = (
    b"transmitter,packet,frame,t_us,symbols,distance_m,distance_sigma_m,x_px,y_px,echo_of\n"
    b"0,0,0,6276,1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16,39.9,0.02,640.5,360.5,\n"
    b"1,0,0,6280,1 2 3 - - 6 7 8 9 10 11 12 13 14 15 16,,,660.5,360.5,0\n"
)
POSES = (
    b"recording,t_us,latitude_deg,longitude_deg,height_m,heading_deg,pitch_deg,roll_deg\n"
    b"a,0,48.1,11.5,520.0,90.0,1.0,0.0\nb,1000,48.2,11.6,521.0,,,\n"
)
ATTITUDE = b"t_us,heading_deg,pitch_deg,roll_deg,sigma_deg\n0,90.0,1.0,0.0,0.1\n5000,91.0,1.5,0.1,0.1\n"
SUMMARY = b'{"status": "complete", "files": {}, "counts": {"a": 1}}'
SITES = b"""[[bar]]
transmitter_id = 17
latitude_deg = 35.0
longitude_deg = 137.0
height_m = 54.5
heading_deg = 0.0
tilt_deg = 0.0
length_m = 0.96
"""
INVENTORY = b"""[defaults]
level_ma = 20

[[board]]
id = "T01"
port = "native:"
position_m = [0.0, 2.1, 5.5]
random = 16
seed = 1
"""


def kinds(folder, store):
    """Every kind.

    Args:
        folder: Where good files may be made.
        store: A finished campaign's results file.
    """
    link = load_link()
    packet, clusters = link.packet, link.codebook.clusters
    truth = json.loads((EXAMPLES / "recordings" / "night-50m-30kmh-cut.truth.json").read_text())
    symbols = np.zeros((1, packet.frames, clusters), int).tolist()
    table = np.stack([column.astype(np.int64) for column in _columns().values()], 1)
    masks = folder / "masks.npy"
    np.save(masks, np.zeros((packet.packet_chips, 16), np.uint8))
    return [
        Kind("EVT3", "a.raw", _recording(folder, "3.raw"), read_recording),
        *(Kind(name, "a.raw", _recording(folder, name, name), read_recording) for name in ("EVT2", "EVT21")),
        Kind("NPZ", "a.npz", _recording(folder, "a.npz"), read_recording),
        Kind("CSV", "a.csv", _recording(folder, "a.csv"), read_recording),
        Kind("CSV in gzip", "a.csv.gz", _recording(folder, "a.csv.gz"), read_recording),
        Kind("NPY", "a.npy", write_file(folder / "a.npy", write_npy, {"": table}), read_recording),
        Kind("HDF5", "a.h5", write_file(folder / "a.h5", write_hdf5, _columns()), read_recording),
        Kind("MAT 7.3", "a.mat", write_file(folder / "7.mat", write_mat_73, _columns()), read_recording),
        Kind("MAT", "a.mat", write_file(folder / "5.mat", write_mat, _columns()), read_recording),
        Kind("MCAP", "a.mcap", _recording(folder, "a.mcap"), read_recording),
        Kind("db3", "a.db3", _db3(folder), read_recording),
        Kind("NMEA", "a.nmea", NMEA, lambda path: read_nmea(path, datetime(2026, 11, 1, tzinfo=UTC), 3.0)),
        Kind("update", "a.json", UPDATE.to_json().encode(), UpdatePackage.read),
        Kind("truth", "a.truth.json", json.dumps(truth).encode(), read_truth),
        Kind("frames.csv", "frames.csv", FRAMES, lambda path: read_frames(path.parent)),
        Kind("summary.json", "summary.json", SUMMARY, lambda path: read_summary(path.parent)),
        Kind("poses", "a.csv", POSES, read_poses),
        Kind("attitude", "a.csv", ATTITUDE, AttitudeLog.read),
        Kind("sites", "a.toml", SITES, load_sites),
        Kind("link", "a.toml", (EXAMPLES / "link.toml").read_bytes(), load_link),
        Kind("scene", "a.toml", (EXAMPLES / "scenes" / "street.toml").read_bytes(), load_scene),
        Kind("campaign", "a.toml", (EXAMPLES / "campaigns" / "rates.toml").read_bytes(), plan_campaign),
        Kind("results", "a.sqlite", store, summary_file),
        Kind("symbols", "a.json", json.dumps({"symbols": symbols}).encode(), lambda p: read_symbols(p, None)),
        Kind("masks", "a.npy", masks.read_bytes(), lambda p: read_masks(p, link)),
        Kind("inventory", "a.toml", INVENTORY, read_inventory),
    ]
