"""The whole link on this machine: a text, an emulated board, its LEDs, a scene, a recording, the text."""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evlcp_sdk.air.blocks import Message
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.files import Outputs, read_json, writing
from evlcp_sdk.formatting import format_count
from evlcp_sdk.link.compose import encode_messages, make_messages
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.link.text import to_toml
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.run import receive_to_folder
from evlcp_sdk.sim import read_truth
from evlcp_sdk.sim.truth import truth_path
from evlcp_sdk.simulated import simulate
from evlcp_sdk.study.frames import read_frames
from evlcp_sdk.study.score import score_frames
from firmware_host.board.bank import make_bank, symbol_chips
from firmware_host.board.board import Board, ProgramResult, Progress, Settings, provision
from firmware_host.board.session import Session
from firmware_host.board.symbols import symbols_table
from firmware_host.board.tables import info_table
from firmware_host.emulators.led_record import LedRecord
from firmware_host.emulators.simulated import SimulatedBoard, SimulatedLine
from firmware_host.errors import VerifyError
from firmware_host.protocol.client import Timing
from firmware_host.protocol.generated.requests import DEFAULT_BAUD

RECORDING = "loop.raw"
"""Name of the recording in the folder."""

RECEIVED = "received"
"""Name of the result's folder in it."""

_CHIPS = "chips.npy"
"""Name of the file with the LEDs' chips."""

_MIN_PACKETS = 8
"""Least number of packets in view: a quarter of a second of the default link."""

_TRANSMITTER_ID = 1


@dataclass(frozen=True, eq=False)
class EmulatedLight:
    """The light of an emulated board's LEDs from START on.

    Attributes:
        record: The LEDs, chip by chip.
        chips: The chips of the clusters, uint8 (chips, clusters).
        rate_hz: Chips a second by the board's own crystal.
        programmed: The result of programming.
        firmware: Version of the board's firmware.
    """

    record: LedRecord
    chips: NDArray[np.uint8]
    rate_hz: float
    programmed: ProgramResult
    firmware: str


def light_of(symbols: ArrayLike, link: Link, chips: int, trace: Path | None = None) -> EmulatedLight:
    """Program an emulated board like one on a serial line, and record its LEDs.

    The board runs the real firmware, compiled for this machine, in virtual time.

    Args:
        symbols: Symbols, int64 (packets, frames, clusters), played repeatedly.
        link: Their link.
        chips: Least number of chips to record.
        trace: File to record the line in, as `evlcp board --trace` does.

    Raises:
        BoardError: The board refuses, or its LEDs do not play the symbols.
        ConfigError: A board cannot play this link.
        OutputError: The trace cannot be written.
        ToolchainError: The firmware cannot be built: no C compiler, or no make.
    """
    bank = make_bank(symbols, link)
    device = SimulatedBoard()
    with Session(SimulatedLine(device, "emulated"), Timing(DEFAULT_BAUD), trace=trace) as session:
        board = Board(session)
        programmed = provision(board, bank, Settings())
        device.run(math.ceil(chips / link.air.chip_rate_hz * 1e6) + 1000)
        info = board.info
        record = device.take_led_record().select_chips()
    expected = symbol_chips(symbols, link)
    played = record.chips(link.bar.led_clusters())
    differ = played != expected[np.arange(len(played)) % len(expected)]
    if len(played) < chips or differ.any():
        raise VerifyError(
            f"emulated: its LEDs did {len(played)} chips, expected at least {chips};"
            f" {np.count_nonzero(differ)} of them are not what the symbols say"
        )
    rate_hz = (len(record) - 1) * info.tick_hz / float(record.ticks[-1] - record.ticks[0])
    return EmulatedLight(record, played, rate_hz, programmed, info_table(info)["firmware"])


@dataclass(frozen=True)
class Step:
    """One step of the loop, when it is done.

    Attributes:
        name: message, board, light, scene, receiver or text.
        summary: The measurements as text.
        figures: The measurements as JSON values.
        files: Names of the files that it wrote in the folder.
    """

    name: str
    summary: str
    figures: dict[str, Any]
    files: tuple[str, ...] = ()


def run_loop(
    text: str,
    link: Link,
    folder: Path,
    *,
    distance_m: float = 50.0,
    seed: int = 0,
    sinks: Sequence[str] = (),
    progress: Progress = lambda *_: None,
) -> Iterator[Step]:
    """Send a text by an emulated board to a simulated camera, and read it; yield each step when it is done.

    Every step writes its files to the folder, and the next one reads them.

    Args:
        text: The text.
        link: The link of both ends.
        folder: Folder of all files, created if missing.
        distance_m: From the camera to the bar.
        seed: Of the scene: its noise, and the camera's start in a packet.
        sinks: Output formats besides the default ones, by name.
        progress: Called while the scene is rendered, with seconds done and seconds in all.

    Raises:
        BoardError: The board refuses; see `light_of`.
        ConfigError: The text cannot be sent, a board cannot play the link, or the scene cannot be rendered.
        OutputError: The folder cannot be written.
        ToolchainError: The firmware cannot be built.
    """
    if not text:
        raise ConfigError("text: expected at least one character")
    if not link.messages.decode:
        raise ConfigError("messages.decode = false: expected true, or the text is not read")
    nearest_m = link.bar.length_m * link.camera.focal_px / link.camera.height
    if distance_m < nearest_m:
        raise ConfigError(
            f"distance = {distance_m:g} m: the bar, {link.bar.length_m:g} m high, fits into the image from"
            f" {nearest_m:.1f} m on"
        )
    coder = link.block_coder()
    (message,) = make_messages(link, text=text, transmitter_id=_TRANSMITTER_ID, sequence=seed & 0xFFFFFFFF)
    symbols = encode_messages([message], coder)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    yield _message_step(text, message, symbols, link, folder)

    # Every packet is seen whole, the second time if the first began before the camera.
    in_view = max(_MIN_PACKETS, 2 * len(symbols) + 2)
    light = light_of(symbols, link, (in_view + 2) * link.packet.packet_chips, folder / "wire.jsonl")
    programmed = light.programmed
    yield Step(
        "board",
        f"emulated, firmware {light.firmware}: programmed over its line ({programmed.length} bytes),"
        " read back, started",
        {"firmware": light.firmware, "payload_bytes": programmed.length, "retries": programmed.retries},
        ("wire.jsonl",),
    )
    yield _light_step(light, link, folder)
    scene = _make_scene(light, link, folder / _CHIPS, distance_m, in_view, seed)
    yield _scene_step(scene, symbols, len(light.chips) // link.packet.packet_chips, folder, seed, progress)

    yield _receiver_step(link, folder, sinks)
    yield _text_step(text, folder / RECEIVED)


def _message_step(text: str, message: Message, symbols: NDArray[np.int64], link: Link, folder: Path) -> Step:
    packet = link.packet
    with Outputs() as outputs:
        outputs.write_text(to_toml(link, Registry.load()), folder / "link.toml")
        outputs.write_text(
            json.dumps(symbols_table(symbols, link, messages=True)) + "\n", folder / "message.json"
        )
    count, size = len(symbols), len(message.payload)
    bits, chips = link.block_coder().bits * count, packet.packet_chips * count
    duration_s = round(chips / link.air.chip_rate_hz, 6)
    figures = {
        "text": text,
        "bytes": size,
        "packets": count,
        "symbols": symbols.size,
        "bits": bits,
        "chips": chips,
        "duration_s": duration_s,
    }
    summary = (
        f'"{text}", {size} bytes: {format_count(count, "packet")} with error correction, {bits} bits as'
        f" {symbols.size} symbols in {chips} chips, {1e3 * duration_s:.4g} ms"
    )
    return Step("message", summary, figures, ("link.toml", "message.json"))


def _light_step(light: EmulatedLight, link: Link, folder: Path) -> Step:
    with Outputs() as outputs:
        outputs.write_bytes(light.record.to_bytes(), folder / "leds.bin")
        outputs.write_array(light.chips, folder / _CHIPS)
    leds, chips = len(link.bar.led_clusters()), len(light.chips)
    rate_hz, on_share = round(light.rate_hz, 3), round(float(light.chips.mean()), 4)
    figures = {"leds": leds, "chips": chips, "chip_rate_hz": rate_hz, "on_share": on_share}
    summary = (
        f"{format_count(leds, 'LED')}, {rate_hz:g} chips a second, on for {on_share:.0%} of the time;"
        f" {chips} chips watched, each what the message says"
    )
    return Step("light", summary, figures, ("leds.bin", _CHIPS))


def _make_scene(
    light: EmulatedLight, link: Link, chips_file: Path, distance_m: float, in_view: int, seed: int
) -> dict[str, Any]:
    start_chip = float(np.random.default_rng([seed, 1]).uniform(0, link.packet.packet_chips))
    bar = {
        "x_m": 0.0,
        "chips_file": str(chips_file),
        "start_chip": round(start_chip, 1),
        "ppm": round((light.rate_hz / link.air.chip_rate_hz - 1) * 1e6, 3),
    }
    # A still camera: the vibration of a car would show more than a first example needs.
    return {
        "name": Path(RECORDING).stem,
        "duration_s": in_view * link.packet.packet_chips / light.rate_hz,
        "link": {section: dict(keys) for section, keys in link.table.items()},
        "camera": dict(link.table["camera"]),
        "lens": {"focus_m": distance_m},
        "motion": {"distance_m": distance_m, "speed_mps": 0.0, "vib_rate_rad_s": 0.0},
        "bars": [bar],
    }


def _scene_step(
    scene: dict[str, Any],
    symbols: NDArray[np.int64],
    packets: int,
    folder: Path,
    seed: int,
    progress: Progress,
) -> Step:
    raw, duration_s = folder / RECORDING, scene["duration_s"]
    simulated = simulate(scene, seed)
    _, truth_file = simulated.save(raw, lambda done_s: progress(done_s, duration_s))
    _add_symbols(truth_file, symbols, packets)
    distance_m, events = scene["motion"]["distance_m"], simulated.simulation.counts["events"]
    size, duration_s = raw.stat().st_size, round(duration_s, 6)
    figures = {"distance_m": distance_m, "duration_s": duration_s, "events": events, "bytes": size}
    summary = (
        f"a still camera {distance_m:g} m away looks for {duration_s:.2g} s:"
        f" {events / 1e6:.2f} million events, {size / 1e6:.1f} MB"
    )
    return Step("scene", summary, figures, (raw.name, truth_file.name))


def _receiver_step(link: Link, folder: Path, sinks: Sequence[str]) -> Step:
    raw = folder / RECORDING
    summary = receive_to_folder(raw, folder / RECEIVED, link, sinks=sinks)
    transmitters = summary["transmitters"]
    # The written rows, as for `evlcp score`.
    score = score_frames(read_frames(folder / RECEIVED), read_truth(truth_path(raw)))
    (scored,), (road,) = score["bars"], score["road"]["bars"]
    figures = {
        "result": summary["result"],
        "frames": scored["frames_found"],
        "frames_sent": scored["frames_sent"],
        "frames_false": score["unmatched"],
        "bits": road["bits"],
        "bit_errors": road["bit_errors"],
        "distance_m": transmitters[0]["distance_last_m"] if transmitters else None,
        "rmse_m": scored["rmse_m"],
        "warnings": summary["warnings"],
    }
    files = tuple(f"{RECEIVED}/{name}" for name in (*summary["files"], "summary.json"))
    return Step("receiver", _describe_frames(figures), figures, files)


def _describe_frames(figures: dict[str, Any]) -> str:
    frames, sent, errors, bits = (figures[key] for key in ("frames", "frames_sent", "bit_errors", "bits"))
    if not frames:
        return f"{figures['result']}; {sent} frames were sent"
    share = errors / bits if bits else 0.0
    summary = f"{frames} of {sent} frames, {errors} of {bits} bits wrong (BER {share:.2g})"
    return summary + ("" if figures["distance_m"] is None else f"; distance {figures['distance_m']:.2f} m")


def _text_step(text: str, received: Path) -> Step:
    counts = read_json(received / "summary.json")["counts"]
    with (received / "packets.jsonl").open(encoding="utf-8") as file:
        rows = [json.loads(line) for line in file]
    texts = list(dict.fromkeys(row["text"] for row in rows if row["kind"] == "text"))
    packets = counts["blocks_decoded"] + counts["blocks_combined"]
    quoted, as_sent = ", ".join(f'"{one}"' for one in texts), text in texts
    times = "once" if packets == 1 else f"from {packets} packets"
    summary = f"{quoted}, read {times}" + ("" if as_sent else ": not what was sent")
    figures = {"texts": texts, "packets": packets, "as_sent": as_sent}
    return Step("text", summary if texts else "none was read", figures)


def _add_symbols(truth_file: Path, symbols: NDArray[np.int64], packets: int) -> None:
    """Replace the LEDs' chips in the truth by their symbols, which `light_of` has compared."""
    table = read_json(truth_file)
    (bar,) = table["bars"]
    whole = symbols[np.arange(packets) % len(symbols)]
    bar |= {
        "symbols": whole.tolist(),
        "payload": "messages",
        "chips_file": None,
        "packet_chips": bar["packet_chips"] // packets,
    }
    with Outputs() as outputs:
        outputs.write_text(json.dumps(table), truth_file)
