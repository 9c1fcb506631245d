import json
from pathlib import Path

import numpy as np
import pytest

import evlcp_sdk as evlcp
from evlcp_sdk.air.frames import bits_of_symbols
from evlcp_sdk.results.summary import RunEnd
from evlcp_sdk.results.writer import ResultWriter
from evlcp_sdk.rx.inbox import MessageAssembler


def packet_of(symbols: np.ndarray, link: evlcp.Link) -> evlcp.Packet:
    """A packet as it is received without an error: symbols (frames, clusters)."""
    bits = bits_of_symbols(symbols, link.codebook.bits_per_symbol)
    llr = (8 * (1 - 2.0 * bits)).astype(np.float32).reshape(*symbols.shape, -1)
    frames = tuple(
        evlcp.Frame(
            transmitter=0,
            packet=0,
            frame=number,
            t_us=3200.0 * number,
            soft=evlcp.SoftSymbols(symbols[number], llr[number], 1.0),
            range=evlcp.Range(50.0 - number, 0.25, 9)
            if number % 2
            else evlcp.Range(float("nan"), float("nan"), 0),
            filtered=None,
            x_px=0.0,
            y_px=0.0,
        )
        for number in range(len(symbols))
    )
    return evlcp.Packet(0, 0, 0.0, 100.0, frames, len(symbols))


def test_both_are_received(tmp_path: Path) -> None:
    link = evlcp.load_link()
    (symbols,) = evlcp.compose(link, other={"speed-limit": (30, 2000)}, transmitter_id=7, sequence=1)
    inbox = MessageAssembler.of(link)
    with ResultWriter(tmp_path, link, sinks=["distance-lines"]) as writer:
        writer.write([inbox.add(packet_of(symbols, link))])
        summary = writer.finish(RunEnd("complete", counts=inbox.counts))
    _, line = (json.loads(text) for text in (tmp_path / "packets.jsonl").read_text().splitlines())
    assert (line["kind"], line["transmitter_id"], line["trust"]) == ("speed-limit", 7, "unverified")
    assert (line["speed_km_h"], line["length_m"]) == (30, 2000)
    assert summary["sinks"] == {"distance-lines": {"lines": 5}}
    first = (tmp_path / "distances.line").read_text().splitlines()[0]
    assert first == "distance,transmitter=0 depth_m=49.0000,sigma_m=0.2500 3200000"


def test_what_cannot_be_written_is_refused() -> None:
    with pytest.raises(evlcp.ConfigError, match="speed-limit"):
        evlcp.compose(other={"speed-limit": (300, 1)})
    with pytest.raises(evlcp.ConfigError, match="no message kind named 'speed' "):
        evlcp.compose(other={"speed": 30})
