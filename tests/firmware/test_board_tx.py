"""`evlcp tx`: frames without a board, and what a wrong file is answered."""

import json
from pathlib import Path

import numpy as np
import pytest
from board_lines import LINK, check_fault, options_of, well

from evlcp_sdk.errors import InputError
from firmware_host import flicker
from firmware_host.board.bank import read_masks

AIR = json.loads((Path(__file__).parents[1] / "vectors" / "air-vectors.json").read_text())
EXAMPLE = AIR["example_packet"]


@pytest.fixture
def example(tmp_path):
    path = tmp_path / "symbols.json"
    path.write_text(json.dumps([EXAMPLE["symbols"]]))
    return path


TWO_FRAMES = ("--set", "air.frames_per_packet=2")


def test_chips_are_the_air_vectors(evlcp, example, tmp_path):
    out = tmp_path / "chips.npy"
    well(evlcp("tx", "frames", example, "--chips", out, *TWO_FRAMES))
    chips = np.load(out)
    assert chips.dtype == np.uint8
    assert chips.shape == (90, 16)
    assert [f"{int(''.join(map(str, row)), 2):04x}" for row in chips] == EXAMPLE["cluster_masks"]


def test_every_form_has_the_same_words(evlcp, example):
    table = json.loads(evlcp("tx", "frames", example, "--format", "json", *TWO_FRAMES).out)
    assert table["pilot_words"] == AIR["pilot_words"]
    info = [w for frame in table["info_words"][0] for w in frame]
    expected = [AIR["info_words"]["wh4x2"][s] for frame in EXAMPLE["symbols"] for s in frame]
    assert info == expected
    hexed = evlcp("tx", "frames", example, "--format", "hex", *TWO_FRAMES).out.split()
    assert [h[4:] for h in hexed] == expected
    assert [h[:4] for h in hexed] == 2 * AIR["pilot_words"]
    c = evlcp("tx", "frames", example, "--format", "c", *TWO_FRAMES).out
    assert [w for w in expected if f"0x{w}u" not in c] == []
    rows = evlcp("tx", "frames", example, *TWO_FRAMES).out.splitlines()[1:]
    assert [r.split()[5] for r in rows] == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[", "not JSON"),
        (json.dumps([[[1]] * 10]), "symbols[0][0]: found 1 elements, expected 16 symbols, one per cluster"),
        ("[[[1]]]", "symbols[0]: found 1 elements, expected 10 frames, air.frames_per_packet"),
        ('{"symbol": []}', "key symbols is missing"),
        ('{"link": 3, "symbols": []}', "link = 3, expected the tables of a link"),
        ('{"link": {"pilots": {"id": "w"}}}', "link: no pilots algorithm named 'w'"),
        (json.dumps([[[0] * 15 + [64]] * 10]), "symbols[0][0][15] = 64, expected an integer 0 to 63"),
    ],
)
def test_wrong_symbols_are_one_line(evlcp, tmp_path, text, expected):
    path = tmp_path / "s.json"
    path.write_text(text)
    check_fault(evlcp("tx", "frames", path), 3, f"evlcp: {path}: ", expected)


@pytest.mark.parametrize("digest", ['"00"', "5", "null"])
def test_symbols_of_another_codebook_are_refused(evlcp, tmp_path, digest):
    frames, other = (
        evlcp("tx", "frames", "--random", 1, "--seed", n, "--format", "json").out for n in (0, 1)
    )
    assert frames != other
    path = tmp_path / "s.json"
    path.write_text(frames)
    assert evlcp("tx", "frames", path, "--format", "json").out == frames
    own = json.loads(frames)["codebook"]
    path.write_text(frames.replace(f'"{own}"', digest))
    done = evlcp("tx", "frames", path)
    check_fault(done, 8, f"{path}: codebook = {digest}", f"expected {own[:16]}")


def test_wrong_masks_are_reported(tmp_path):
    path = tmp_path / "m.npy"
    for array, expected in (
        (np.zeros((345, 16), np.uint8), "whole packets of 346 chips"),
        (np.zeros((346, 17), np.uint8), "one column for each of 96 LEDs or 16 clusters"),
        (np.full((346, 16), 2, np.uint8), "integers 0 and 1"),
        (np.zeros((346, 16), np.float64), "integers 0 and 1"),
    ):
        np.save(path, array)
        with pytest.raises(InputError, match=expected):
            read_masks(path, LINK)
    np.savez(tmp_path / "m.npz", np.zeros((346, 16), np.uint8))
    (tmp_path / "m.npz").rename(path)
    with pytest.raises(InputError, match="file of plain numbers"):
        read_masks(path, LINK)
    with path.open("wb") as file:
        header = {"descr": "|u1", "fortran_order": False, "shape": (10**13, 16)}
        np.lib.format.write_array_header_1_0(file, header)
    for content in (path.read_bytes(), b"", b"no array", b"PK\x03\x04junk"):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"not a \.npy file"):
            read_masks(path, LINK)


def test_flicker_of_known_waves():
    # a 100 Hz square wave of full modulation: its fundamental is 4/pi of the mean
    wave = np.tile(np.repeat([[1], [0]], 50, axis=0), (10, 1)).astype(np.uint8)
    row = flicker.measure_flicker(wave, 10_000.0)[0]
    assert row.line_hz == 100.0
    assert row.line_percent == pytest.approx(100 * 4 / np.pi, rel=1e-3)
    assert (row.on_share, row.longest_run, row.low_risk) == (0.5, 50, False)
    # 5 kHz alternation has no line below 3 kHz
    fast = np.tile([[0], [1]], (500, 1)).astype(np.uint8)
    row = flicker.measure_flicker(fast, 10_000.0)[0]
    assert (row.line_percent, row.longest_run, row.no_effect) == (0.0, 1, True)
    # constant light does not flicker, darkness neither
    for level in (0, 1):
        assert flicker.measure_flicker(np.full((100, 1), level, np.uint8), 10_000.0)[0].no_effect


def test_codebook_packets_are_balanced_and_a_payload_that_flickers_ends_with_one(evlcp):
    rows = json.loads(well(evlcp("tx", "check", "--random", 40, "--json")).out)["clusters"]
    assert len(rows) == 16
    assert all(r["on_share"] == 0.5 and r["longest_run"] == 2 and r["low_risk"] for r in rows)
    # at 300 chips/s the codes themselves are slow enough to see
    done = evlcp("tx", "check", "--random", 10, "--set", "air.chip_rate_hz=300.0")
    assert done.code == 1
    assert "FLICKERS" in done.out
    # one without a line below 3 kHz has no limit, which is JSON all the same
    one = options_of("air.frames_per_packet=1", "air.chip_rate_hz=1e6")
    done = evlcp("tx", "check", "--random", 1, "--json", *one)
    rows = json.loads(done.out, parse_constant=pytest.fail)["clusters"]
    assert {row["limit_percent"] for row in rows} == {None}
