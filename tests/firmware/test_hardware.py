"""The page on hardware: its netlist is whole, lights the LED it should, and has the firmware's pins."""

import re
from pathlib import Path

import numpy as np
import pytest

from docs.figures import hardware as bar

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "hardware.md").read_text()
PARTS = bar.parts()
NETS = bar.nets(PARTS)


def test_what_is_written_is_fresh():
    made = bar.files(PARTS)
    assert sorted(made) == sorted(p.name for p in (ROOT / "docs" / "hardware").iterdir())
    for name, text in made.items():
        held = (ROOT / "docs" / "hardware" / name).read_text()
        assert held == text, "python docs/figures/hardware.py --write"


def test_the_page_has_the_figures_and_the_parts():
    assert [row for row in bar.figures(PARTS) if f"| {row[0]} | {row[1]} |" not in PAGE] == []
    for value, _, count, price, refs in bar.bill(PARTS):
        row = rf"\| {re.escape(refs)} \| {re.escape(value)} \|.*\| {count} \| {price:.2f} \|"
        assert price < 0.4 or re.search(row, PAGE)
    assert "Only modelled" in PAGE.splitlines()[2]


def test_the_netlist_is_whole():
    refs = [p.ref for p in PARTS]
    assert len(refs) == len(set(refs))
    assert [net for net, pins in NETS.items() if len(pins) < 2] == []
    outputs = {"OUT", "VOUT", "SDO", "PA4", "PA5", "PA6", "PA7", "PA9", "PB0", "TXD"}
    names = {p.ref: p.pins for p in PARTS}
    for net, pins in NETS.items():
        driving = [(r, n) for r, n in pins if re.sub(r"(OUT)[AB]$", r"\1", names[r][n][0]) in outputs]
        assert len(driving) <= 1, f"{net}: {driving}"
    # what reaches the host crosses the isolation only
    host = {net for net in NETS if net.endswith("HOST") or net.startswith("HOST")}
    inside = set(NETS) - host
    across = {r for net in host for r, _ in NETS[net]} & {r for net in inside for r, _ in NETS[net]}
    assert across == {"U10"}


def test_the_chain_lights_the_led_of_the_row():
    """Shift 96 bits through the netlist, LED 0 first, as the firmware does."""
    parts = {p.ref: dict(p.pins.values()) for p in PARTS}
    drivers = {ref: pins for ref, pins in parts.items() if "SDI" in pins and "LE" in pins and "OUT0" in pins}
    order, net = [], "SDI"
    while (ref := next((r for r, p in drivers.items() if p["SDI"] == net), None)) is not None:
        order.append(ref)
        net = drivers[ref]["SDO"]
    assert len(order) == 6
    row = np.random.default_rng(0).integers(0, 2, 96)
    register = [0] * 96
    for bit in row.tolist():
        register = [bit, *register[:-1]]
    lit = {}
    for place, on in enumerate(register):
        lit[drivers[order[place // 16]][f"OUT{place % 16}"]] = on
    for led in range(96):
        cathode = parts[f"D{led + 1}"]["K"]
        assert lit[cathode] == row[led]
        assert parts[f"D{led + 1}"]["A"] == "+3V3_LED"


def test_pins_are_those_of_the_firmware():
    (chip,) = (p for p in PARTS if p.ref == "U7")
    nets = dict(chip.pins.values())
    hal = (ROOT / "firmware_host" / "firmware" / "hal" / "stm32f405" / "hal.c").read_text()
    reported = dict(re.findall(r"^   \| (P[AB]\d+(?: P[AB]\d+)?) +\| (.*?) +\|$", hal, re.MULTILINE))
    for pins, wanted, words in (
        ("PA9 PA10", ("UART_TX", "UART_RX"), "USART1"),
        ("PA5 PA7", ("CLK", "SDI"), "SPI1 clock and data"),
        ("PA6", ("LE",), "latch"),
        ("PA4", ("LEVEL",), "DAC 1"),
        ("PA0", ("PULSE",), "pulses"),
        ("PB0", ("OE",), "output enable"),
        ("PB1", ("HOT",), "thermal"),
    ):
        assert words in reported[pins]
        assert tuple(nets[pin] for pin in pins.split()) == wanted


def test_dark_without_the_firmware():
    """Each line that could light an LED is pulled to where it does not."""
    pulls = {}
    for part in PARTS:
        nets = [net for _, net in part.pins.values()]
        if part.ref.startswith("R") and len(nets) == 2 and {"+3V3", "GND"} & set(nets):
            rail = "GND" if "GND" in nets else "+3V3"
            pulls[next(n for n in nets if n != rail)] = rail
    assert pulls["OE"] == pulls["HOT"] == "+3V3"
    assert {pulls[net] for net in ("LE", "CLK", "SDI", "LEVEL", "GATE", "PULSE", "BOOT0", "BOOT1")} == {"GND"}
    # no level asks for a current with the pin at 0 V
    assert bar.led_ma(0) == 0.0


def test_currents_and_light_by_formula():
    assert bar.led_ma(60) == pytest.approx(1e3 * 15 * 1.25 / 316, rel=1e-3)
    levels = [bar.led_ma(n) for n in range(61)]
    assert levels == sorted(levels)
    # beyond the beam's width each LED counts as if it stood in the middle
    assert bar.irradiance(30.0, 0.04) == pytest.approx(96 * 0.04 / 30**2, rel=1e-2)
    worst, code = bar.eye(59.3, 1.0), bar.eye(59.3, 0.5)
    for eye in (worst, code):
        assert eye.radiance < eye.radiance_limit
        assert eye.corneal < eye.corneal_limit
    assert worst.radiance == pytest.approx(0.07 * 0.593 / (0.3e-3) ** 2 * 10 ** (-130 / 500))
