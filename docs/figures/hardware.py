"""The bar of `docs/hardware.md`: its parts and nets, and the figures that follow from them.

Prints LED current, heat, supply, timing and an estimate of eye safety. `--write` writes the netlist (KiCad),
the list of parts and the picture of the schematic to `docs/hardware/`.
"""

import argparse
import csv
import io
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

FOLDER = Path(__file__).parents[1] / "hardware"

DRIVERS, OUTPUTS = 6, 16
LEDS = DRIVERS * OUTPUTS


@dataclass(frozen=True)
class Part:
    """A part, and the net of each of its pins.

    Attributes:
        ref: Its name on the board.
        value: Value, or part number.
        what: What it is for.
        footprint: Footprint, as KiCad calls it.
        price_eur: What one costs, to plan with.
        pins: Pin -> (name, net); no net: not connected.
    """

    ref: str
    value: str
    what: str
    footprint: str
    price_eur: float
    pins: dict[str, tuple[str, str | None]]


def two(ref: str, value: str, what: str, a: str, b: str, price: float, footprint: str) -> Part:
    return Part(ref, value, what, footprint, price, {"1": ("1", a), "2": ("2", b)})


def resistor(ref: str, value: str, what: str, a: str, b: str) -> Part:
    return two(ref, value, what, a, b, 0.02, "Resistor_SMD:R_0603_1608Metric")


def capacitor(ref: str, value: str, what: str, a: str, b: str = "GND", price: float = 0.05) -> Part:
    big = value.endswith(("470u", "100u"))
    name = "Capacitor_SMD:CP_Elec_8x10" if big else "Capacitor_SMD:C_0603_1608Metric"
    return two(ref, value, what, a, b, price, name)


def driver(n: int) -> Part:
    """Driver n of the chain, U1 next to the microcontroller."""
    pins: dict[str, tuple[str, str | None]] = {
        "1": ("GND", "GND"),
        "2": ("SDI", "SDI" if n == 1 else f"CHAIN{n - 1}"),
        "3": ("CLK", "CLK"),
        "4": ("LE", "LE"),
        "21": ("/OE", "OE"),
        "22": ("SDO", None if n == DRIVERS else f"CHAIN{n}"),
        "23": ("R-EXT", f"REXT{n}"),
        "24": ("VDD", "+3V3"),
        "25": ("PAD", "GND"),
    }
    for out in range(OUTPUTS):
        # what is shifted in first ends at the last output of the last driver: LED 0
        led = (DRIVERS - n) * OUTPUTS + (OUTPUTS - 1 - out)
        pins[str(5 + out)] = (f"OUT{out}", f"K{led}")
    return Part(f"U{n}", "TLC5926IPWPR", "LED driver, 16 sinks", "Package_SO:HTSSOP-24-1EP", 1.60, pins)


def microcontroller() -> Part:
    nets = {
        "1": ("VBAT", "+3V3"),
        "5": ("PH0", "OSC_IN"),
        "6": ("PH1", "OSC_OUT"),
        "7": ("NRST", "NRST"),
        "12": ("VSSA", "GND"),
        "13": ("VDDA", "VDDA"),
        "14": ("PA0", "PULSE"),
        "18": ("VSS", "GND"),
        "19": ("VDD", "+3V3"),
        "20": ("PA4", "LEVEL"),
        "21": ("PA5", "CLK"),
        "22": ("PA6", "LE"),
        "23": ("PA7", "SDI"),
        "26": ("PB0", "OE"),
        "27": ("PB1", "HOT"),
        "28": ("PB2", "BOOT1"),
        "31": ("VCAP_1", "VCAP1"),
        "32": ("VDD", "+3V3"),
        "42": ("PA9", "UART_TX"),
        "43": ("PA10", "UART_RX"),
        "46": ("PA13", "SWDIO"),
        "47": ("VCAP_2", "VCAP2"),
        "48": ("VDD", "+3V3"),
        "49": ("PA14", "SWCLK"),
        "60": ("BOOT0", "BOOT0"),
        "63": ("VSS", "GND"),
        "64": ("VDD", "+3V3"),
    }
    return Part("U7", "STM32F405RGT6", "microcontroller", "Package_QFP:LQFP-64_10x10mm_P0.5mm", 9.50, nets)


def parts() -> list[Part]:
    """Every part of a bar."""
    found = [driver(n) for n in range(1, DRIVERS + 1)]
    found.append(microcontroller())
    found += [
        Part(
            "U8",
            "OKL-T/6-W12N-C",
            "LED supply, 12 V to 3.3 V, 6 A",
            "Converter_DCDC:OKL-T",
            11.00,
            {
                "VIN": ("VIN", "+12V"),
                "GND": ("GND", "GND"),
                "VOUT": ("VOUT", "+3V3_LED"),
                "SENSE": ("SENSE", "+3V3_LED"),
                "TRIM": ("TRIM", "TRIM"),
                "ON/OFF": ("ON/OFF", None),
            },
        ),
        Part(
            "U9",
            "R-78E3.3-0.5",
            "logic supply, 12 V to 3.3 V, 0.5 A",
            "Converter_DCDC:R-78E",
            3.20,
            {"1": ("VIN", "+12V"), "2": ("GND", "GND"), "3": ("VOUT", "+3V3")},
        ),
        Part(
            "U10",
            "ISO7721D",
            "isolation of the UART, 3 kV",
            "Package_SO:SOIC-8",
            2.20,
            {
                "1": ("VCC1", "+5V_HOST"),
                "2": ("OUTA", "HOST_RXD"),
                "3": ("INB", "HOST_TXD"),
                "4": ("GND1", "GND_HOST"),
                "5": ("GND2", "GND"),
                "6": ("OUTB", "UART_RX"),
                "7": ("INA", "UART_TX"),
                "8": ("VCC2", "+3V3"),
            },
        ),
        Part(
            "U11",
            "MCP6002-I/SN",
            "LED current from the DAC",
            "Package_SO:SOIC-8",
            0.45,
            {
                "1": ("OUTA", "TARGET"),
                "2": ("INA-", "SUM"),
                "3": ("INA+", "HALF"),
                "4": ("VSS", "GND"),
                "5": ("INB+", "RSET"),
                "6": ("INB-", "HOLD"),
                "7": ("OUTB", "GATE_DRIVE"),
                "8": ("VDD", "VDDA"),
            },
        ),
        Part(
            "Q1",
            "AO3400A",
            "sinks what the R-EXT pins give",
            "Package_TO_SOT_SMD:SOT-23",
            0.15,
            {"1": ("G", "GATE"), "2": ("S", "GND"), "3": ("D", "RSET")},
        ),
        two("Y1", "8 MHz, 10 ppm", "crystal", "OSC_IN", "OSC_OUT", 0.70, "Crystal:ABM3B"),
        two("S1", "KSD9700 70 C, opens", "thermostat, glued to the drivers", "HOT", "GND", 0.80, "Wire:S1"),
        two("F1", "fuse 3 A slow", "supply", "+12V_IN", "+12V", 0.40, "Fuse:Fuse_1206"),
        two("FB1", "600 Ohm at 100 MHz", "analogue supply", "+3V3", "VDDA", 0.06, "Inductor_SMD:L_0603"),
        two("SW1", "button", "reset", "NRST", "GND", 0.20, "Button:SW_SPST"),
        two("JP1", "jumper", "set for the ROM bootloader", "+3V3", "BOOT0", 0.10, "Jumper:1x02"),
        two("D97", "SMBJ15A", "surges on the supply", "+12V", "GND", 0.30, "Diode_SMD:D_SMB"),
        two("J1", "terminal 2", "12 V, 2 A, isolated (SELV)", "+12V_IN", "GND", 0.60, "Connector:Term_2"),
        Part(
            "J2",
            "pins 1x4",
            "TTL-232R-5V cable",
            "Connector:1x04",
            0.20,
            {
                "1": ("GND", "GND_HOST"),
                "2": ("VCC", "+5V_HOST"),
                "3": ("TXD", "HOST_TXD"),
                "4": ("RXD", "HOST_RXD"),
            },
        ),
        Part(
            "J4",
            "pins 1x3",
            "pulse of a GPS receiver",
            "Connector:1x03",
            0.20,
            {"1": ("VCC", "+3V3"), "2": ("PPS", "PULSE_IN"), "3": ("GND", "GND")},
        ),
        Part(
            "J3",
            "pins 1x5",
            "debugger (SWD)",
            "Connector:1x05",
            0.20,
            {
                "1": ("VREF", "+3V3"),
                "2": ("SWDIO", "SWDIO"),
                "3": ("SWCLK", "SWCLK"),
                "4": ("NRST", "NRST"),
                "5": ("GND", "GND"),
            },
        ),
    ]
    r = iter(range(1, 100))
    for n in range(1, DRIVERS + 1):
        found.append(resistor(f"R{next(r)}", "316R 1%", f"full current of U{n}", f"REXT{n}", "RSET"))
    for value, what, a, b in (
        ("4k7", "OE up: dark through reset", "+3V3", "OE"),
        ("10k", "LE down: the latch stays shut", "LE", "GND"),
        ("10k", "CLK down", "CLK", "GND"),
        ("10k", "SDI down", "SDI", "GND"),
        ("10k", "level down: no current through reset", "LEVEL", "GND"),
        ("4k7", "HOT up: a broken wire is hot", "+3V3", "HOT"),
        ("10k", "BOOT0 down: runs from flash", "BOOT0", "GND"),
        ("10k", "BOOT1 down: ROM bootloader", "BOOT1", "GND"),
        ("26k1 1%", "DAC to sum", "LEVEL", "SUM"),
        ("10k0 1%", "gain", "SUM", "TARGET"),
        ("26k1 1%", "offset", "VDDA", "HALF"),
        ("10k0 1%", "offset", "HALF", "GND"),
        ("10k", "loop of the current set", "TARGET", "HOLD"),
        ("100R", "gate", "GATE_DRIVE", "GATE"),
        ("100k", "gate down: no current without the amplifier", "GATE", "GND"),
        ("432R 1%", "3.3 V of the LED supply", "TRIM", "GND"),
        ("1k", "pulse input", "PULSE_IN", "PULSE"),
        ("10k", "PULSE down: no pulse without a wire", "PULSE", "GND"),
    ):
        found.append(resistor(f"R{next(r)}", value, what, a, b))
    c = iter(range(1, 100))
    for n in range(1, DRIVERS + 1):
        found.append(capacitor(f"C{next(c)}", "100n", f"at U{n}", "+3V3"))
        found.append(capacitor(f"C{next(c)}", "470u", f"LEDs of U{n}", "+3V3_LED", price=0.45))
    for value, what, a, b in (
        ("100n", "U7", "+3V3", "GND"),
        ("100n", "U7", "+3V3", "GND"),
        ("100n", "U7", "+3V3", "GND"),
        ("4u7", "U7", "+3V3", "GND"),
        ("2u2", "U7 core", "VCAP1", "GND"),
        ("2u2", "U7 core", "VCAP2", "GND"),
        ("1u", "analogue", "VDDA", "GND"),
        ("100n", "analogue", "VDDA", "GND"),
        ("100n", "reset", "NRST", "GND"),
        ("27p", "crystal, 18 pF load", "OSC_IN", "GND"),
        ("27p", "crystal, 18 pF load", "OSC_OUT", "GND"),
        ("100n", "U10, host", "+5V_HOST", "GND_HOST"),
        ("100n", "U10", "+3V3", "GND"),
        ("100u", "input", "+12V", "GND"),
        ("10u", "U9", "+3V3", "GND"),
        ("1n", "loop of the current set", "GATE_DRIVE", "HOLD"),
    ):
        found.append(capacitor(f"C{next(c)}", value, what, a, b))
    for led in range(LEDS):
        pins = {"1": ("K", f"K{led}"), "2": ("A", "+3V3_LED")}
        found.append(Part(f"D{led + 1}", "TSHG8400", "LED", "LED_THT:LED_D5.0mm", 0.45, pins))
    return found


def nets(found: list[Part]) -> dict[str, list[tuple[str, str]]]:
    """Net -> (part, pin) of each of its pins."""
    table: dict[str, list[tuple[str, str]]] = {}
    for part in found:
        for pin, (_, net) in part.pins.items():
            if net is not None:
                table.setdefault(net, []).append((part.ref, pin))
    return table


def netlist(found: list[Part]) -> str:
    """The netlist that KiCad's board editor reads."""

    def rows() -> Iterator[str]:
        yield '(export (version "E")'
        yield "  (components"
        for part in found:
            yield f'    (comp (ref "{part.ref}") (value "{part.value}") (footprint "{part.footprint}"))'
        yield "  )"
        yield "  (nets"
        for code, (net, pins) in enumerate(sorted(nets(found).items()), 1):
            yield f'    (net (code "{code}") (name "{net}")'
            yield from (f'      (node (ref "{ref}") (pin "{pin}"))' for ref, pin in pins)
            yield "    )"
        yield "  )"
        yield ")"

    return "\n".join(rows()) + "\n"


def bill(found: list[Part]) -> list[tuple[str, str, int, float, str]]:
    """Value, what it is for, count, price of one, and names, of each kind of part."""
    kinds: dict[str, list[Part]] = {}
    for part in found:
        kinds.setdefault(part.value, []).append(part)
    rows = []
    for value, same in kinds.items():
        what = "; ".join(dict.fromkeys(p.what for p in same))
        refs = " ".join(p.ref for p in same) if len(same) <= 12 else f"{same[0].ref} to {same[-1].ref}"
        rows.append((value, what, len(same), same[0].price_eur, refs))
    return rows


def bill_csv(found: list[Part]) -> str:
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(("value", "what", "count", "price_eur", "parts"))
    table.writerows((v, w, n, f"{p:.2f}", refs) for v, w, n, p, refs in bill(found))
    return text.getvalue()


ROW, CHAR, LABEL, BODY, GAP = 14, 6.2, 92, 150, 26


def picture(found: list[Part]) -> str:
    """The schematic: a box a part, every pin with the name of its net; of the LEDs the first and the last."""
    big = [p for p in found if len(p.pins) > 2]
    small = [p for p in found if len(p.pins) == 2 and not (p.value == "TSHG8400" and 2 < int(p.ref[1:]) < 95)]
    columns = 4
    width = columns * (BODY + 2 * LABEL + GAP) + GAP
    out: list[str] = []
    heights = [60.0] * columns

    def text(
        x: float, y: float, content: str, anchor: str = "start", size: int = 10, bold: bool = False
    ) -> None:
        weight = ' font-weight="bold"' if bold else ""
        place = f'x="{x:.0f}" y="{y:.0f}" font-size="{size}" text-anchor="{anchor}"{weight}'
        out.append(f"<text {place}>{escape(content)}</text>")

    def pin(x: float, y: float, number: str, name: str, net: str | None, right: bool) -> None:
        sign = 1 if right else -1
        out.append(f'<path d="M{x:.0f} {y - 3:.0f}h{sign * 16}" stroke="#333"/>')
        if number != name:
            text(x + sign * 3, y - 5, number, "start" if right else "end", 7)
        text(x - sign * 4, y, name, "end" if right else "start", 9)
        text(x + sign * 20, y, net or "not connected", "start" if right else "end", 9, net is not None)

    for part in big:
        column = heights.index(min(heights))
        half = (len(part.pins) + 1) // 2
        x = GAP + column * (BODY + 2 * LABEL + GAP) + LABEL
        y = heights[column]
        height = half * ROW + 12
        text(x, y - 4, f"{part.ref}  {part.value}", size=11, bold=True)
        out.append(
            f'<rect x="{x}" y="{y:.0f}" width="{BODY}" height="{height}" fill="#fffbe6" stroke="#333"/>'
        )
        for i, (number, (name, net)) in enumerate(part.pins.items()):
            right = i >= half
            pin(x + BODY * right, y + ROW * (i % half + 1) + 2, number, name, net, right)
        heights[column] += height + 34
    top = max(heights) + 10
    text(GAP, top, "Parts with two pins: net - part - net", size=11, bold=True)
    per = math.ceil(len(small) / columns)
    for i, part in enumerate(small):
        x = GAP + i // per * (BODY + 2 * LABEL + GAP)
        y = top + 20 + i % per * 18
        (_, a), (_, b) = part.pins.values()
        text(x + LABEL - 4, y + 4, a or "", "end", 9, True)
        out.append(f'<path d="M{x + LABEL} {y}h14m{BODY - 28 + 14} 0h14" stroke="#333" fill="none"/>')
        box = f'x="{x + LABEL + 14}" y="{y - 8}" width="{BODY - 14}" height="15"'
        out.append(f'<rect {box} fill="#eef6ff" stroke="#333"/>')
        text(x + LABEL + 7 + BODY / 2, y + 3, f"{part.ref}  {part.value}", "middle", 9)
        text(x + LABEL + BODY + 18, y + 4, b or "", "start", 9, True)
    bottom = top + 20 + per * 18 + 10
    title = "Pins of one name are one net. D3 to D94 as D1: anode +3V3_LED, cathode K2 to K93."
    head = (
        '<svg xmlns="http://www.w3.org/2000/svg" font-family="sans-serif"'
        f' viewBox="0 0 {width} {bottom:.0f}">\n'
        f'<rect width="{width}" height="{bottom:.0f}" fill="#fff"/>\n'
    )
    text(GAP, 26, title, size=13, bold=True)
    return head + "\n".join(out) + "\n</svg>\n"


# ---- figures

VREF, RATIO, SUPPLY = 1.25, 15.0, 3.3
REXT, GAIN = 316.0, 10.0 / 26.1
DAC_FULL, LEVEL_MAX_MA = 4095, 60
DUTY = 0.5
VF, INTENSITY_100MA, HALF_ANGLE, WAVELENGTH_NM, DIE_MM = 1.5, 0.070, 22.0, 830.0, 0.3
JUNCTION_K_PER_W = 230.0
PITCH_M = 0.01


def led_ma(level_ma: int) -> float:
    """LED current that a level gives: 15 times what flows from R-EXT at 1.25 V to the amplifier's target."""
    dac = level_ma * DAC_FULL // LEVEL_MAX_MA / DAC_FULL * SUPPLY
    target = GAIN * (SUPPLY - dac)
    return max(0.0, 1e3 * RATIO * (VREF - target) / REXT)


def irradiance(distance_m: float, each: float) -> float:
    """Irradiance before the middle of the bar, W/m2, of LEDs of `each` W/sr on their axes.

    Off axis an LED falls as cos^m, m from its angle of half intensity.
    """
    m = math.log(0.5) / math.log(math.cos(math.radians(HALF_ANGLE)))
    total = 0.0
    for led in range(LEDS):
        aside = (led - (LEDS - 1) / 2) * PITCH_M
        cosine = distance_m / math.hypot(distance_m, aside)
        total += each * cosine ** (m + 1) / (distance_m**2 + aside**2)
    return total


@dataclass(frozen=True)
class Eye:
    """The estimate by IEC 62471 at 200 mm, longer than 1000 s: what is there, and where risk group 0 ends."""

    radiance: float
    radiance_limit: float
    corneal: float
    corneal_limit: float


def eye(current_ma: float, duty: float) -> Eye:
    """Eye safety of the infrared bar.

    The radiance is that of the bare die, as if the lens did not enlarge it: more than any eye meets. It is
    weighted by the burn hazard, 10^((700 - wavelength) / 500), and held against 6000 / alpha W/m2/sr for a
    weak visual stimulus, with alpha = 11 mrad, the least for looking longer than 10 s.
    """
    each = INTENSITY_100MA * current_ma / 100.0 * duty
    weight = 10 ** ((700.0 - WAVELENGTH_NM) / 500.0)
    die_m2 = (DIE_MM * 1e-3) ** 2
    return Eye(each * weight / die_m2, 6000.0 / 0.011, irradiance(0.2, each), 100.0)


PPM = {"crystal, made": 10.0, "crystal, -40 to 85 C": 15.0, "ageing, 10 years": 10.0, "load capacitors": 10.0}
"""Parts per million that add up to what the clock may be off."""


def figures(found: list[Part]) -> list[tuple[str, str]]:
    """Name and value of each figure."""
    full = led_ma(LEVEL_MAX_MA)
    peak_a = LEDS * full * 1e-3
    driver_w = OUTPUTS * full * 1e-3 * (SUPPLY - VF) * DUTY
    led_w = VF * full * 1e-3 * DUTY
    worst, normal = eye(full, 1.0), eye(full, DUTY)
    ppm = sum(PPM.values())
    rows = [(f"LED current at level {n} mA", f"{led_ma(n):.1f} mA") for n in (0, 5, 20, 40, 60)]
    rows += [
        ("all LEDs on, 3.3 V", f"{peak_a:.2f} A"),
        ("the same on the average of a balanced code", f"{peak_a * DUTY:.2f} A"),
        ("power from 12 V, supplies of 88 %", f"{peak_a * DUTY * SUPPLY / 0.88 + 0.5:.1f} W"),
        ("heat of a driver", f"{driver_w:.2f} W"),
        ("heat of a driver, all LEDs on for good", f"{driver_w / DUTY:.2f} W"),
        ("heat of an LED", f"{led_w * 1e3:.0f} mW, {led_w * JUNCTION_K_PER_W:.0f} K"),
        ("a word on its way to the chain", f"{16 / 10.5:.2f} us at 10.5 MHz"),
        ("clock, worst case", f"{ppm:.0f} ppm"),
        ("the same over a packet of 346 chips", f"{346 * ppm * 1e-6:.3f} chips"),
        ("radiance, weighted, code", f"{normal.radiance:.2g} of {normal.radiance_limit:.2g} W/m2/sr"),
        (
            "radiance, weighted, all on for good",
            f"{worst.radiance:.2g} of {worst.radiance_limit:.2g} W/m2/sr",
        ),
        ("cornea, code", f"{normal.corneal:.1f} of {normal.corneal_limit:.0f} W/m2"),
        ("cornea, all on for good", f"{worst.corneal:.1f} of {worst.corneal_limit:.0f} W/m2"),
        ("parts", f"{len(found)}, {sum(p.price_eur for p in found):.0f} EUR"),
    ]
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="write docs/hardware/")
    arguments = parser.parse_args()
    found = parts()
    if arguments.write:
        FOLDER.mkdir(exist_ok=True)
        for name, made in files(found).items():
            (FOLDER / name).write_text(made, encoding="utf-8")
    for name, value in figures(found):
        print(f"| {name} | {value} |")


def files(found: list[Part]) -> dict[str, str]:
    """What `docs/hardware/` holds, by name."""
    return {"bar.net": netlist(found), "bar.csv": bill_csv(found), "bar.svg": picture(found)}


if __name__ == "__main__":
    main()
