"""`evlcp board build`, `flash` and `update`: the firmware as files, in a part, and over a board's line."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from evlcp_sdk.cli._common import print_result, progress_bar
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.files import Outputs, writing
from firmware_host.commands import _host as host
from firmware_host.commands._json import AsJson
from firmware_host.commands._line import BoardLine, LineCommand, from_command_line, open_board

Target = Literal["stm32f405-8mhz", "stm32f405-12mhz"]
"""Boards with an image, by part and crystal."""


class FlashCommand(LineCommand):
    """A command on a part that waits in its ROM."""

    line = ("port", "baud")


def build_images(
    target: Annotated[Target, typer.Option(help="Part and crystal.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FOLDER", help="Where to.")] = Path(),
    as_json: AsJson = False,
) -> None:
    """Build the firmware: TARGET.elf, .hex, .bin, and .update.json.

    For example: [bold]evlcp board build --target stm32f405-8mhz -o build[/]
    """
    elf = host.build.arm_image(target)
    image = host.images.FlashImage.read(elf)
    contents = {suffix: elf.with_suffix(suffix).read_bytes() for suffix in (".elf", ".hex", ".bin")}
    contents[".update.json"] = host.update.UpdatePackage.build(target).to_json().encode()
    paths = [output / f"{target}{suffix}" for suffix in contents]
    with writing(output):
        output.mkdir(parents=True, exist_ok=True)
    with Outputs() as outputs:
        for path, content in zip(paths, contents.values(), strict=True):
            outputs.write_bytes(content, path)
    table = {
        "target": target,
        "address": image.address,
        "bytes": len(image.data),
        "files": [str(path) for path in paths],
    }
    print_result(
        f"{paths[0]}, .hex, .bin, .update.json: {len(image.data)} bytes at {image.address:#x}", table, as_json
    )


def flash(
    context: typer.Context,
    file: Annotated[Path | None, typer.Argument(metavar="FILE", help="Image: .elf, .hex or .bin.")] = None,
    target: Annotated[Target | None, typer.Option(help="Or build it for a part and crystal.")] = None,
    verify: Annotated[bool, typer.Option(help="Read it back.")] = True,
    start: Annotated[bool, typer.Option(help="Run it when done.")] = True,
    brown_out: Annotated[
        bool, typer.Option("--brown-out", help="Set the option bytes, too: reset below 2.7 V.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Put an image into a part by the boot loader in its ROM (AN3155).

    Set BOOT0 high and press reset before; low again, and reset, after. What SAVE keeps stays.

    For example: [bold]evlcp board flash --target stm32f405-8mhz --port /dev/ttyUSB0[/]
    """
    if (file is None) == (target is None):
        raise ConfigError("give an image, or --target to build one, one of the two")
    line: BoardLine = context.obj
    if line.port is None:
        raise ConfigError("--port: expected the part's serial port; a part in its ROM is not asked for")
    image = host.images.FlashImage.read(file or host.build.arm_image(target or ""))
    given = from_command_line(context, "baud") or (
        context.parent is not None and from_command_line(context.parent, "baud")
    )
    transport = host.transport.open_transport(
        line.port, line.baud if given else host.rom.BAUD, even_parity=True
    )
    try:
        loader = host.rom.RomLoader(transport)
        had_brown_out = loader.has_brown_out()
        with progress_bar("flashing") as progress:
            sectors = host.rom.flash_image(loader, image, verify, start and not brown_out, progress)
        if brown_out:
            loader.set_brown_out()
    finally:
        transport.close()
    table = {
        "port": line.port,
        "address": image.address,
        "bytes": len(image.data),
        "sectors": sectors,
        "verified": verify,
        "started": start and not brown_out,
        "brown_out": brown_out or had_brown_out,
    }
    words = [f"{line.port}: {len(image.data)} bytes in sectors {sectors[0]} to {sectors[-1]}"]
    words += ["read back"] * verify + ["brown-out reset set"] * brown_out
    words.append("BOOT0 low and reset starts it")
    if table["brown_out"] is False:
        words.append("brown-out reset is off: flash with --brown-out, or LEDs may stay lit below 2.7 V")
    print_result("; ".join(words), table, as_json)


def update(
    context: typer.Context,
    file: Annotated[Path | None, typer.Argument(metavar="FILE", help="TARGET.update.json.")] = None,
    target: Annotated[Target | None, typer.Option(help="Or build it for a part and crystal.")] = None,
    confirm: Annotated[
        bool, typer.Option("--confirm", help="Only keep the image that runs on trial.")
    ] = False,
    keep: Annotated[bool, typer.Option(help="Keep the new one once it answers; else it is on trial.")] = True,
    as_json: AsJson = False,
) -> None:
    """Bring another firmware onto a dark board, over its own line.

    It runs on trial until it has answered; one that does not is left at the third reset, and the one before
    runs again. The power may fail at any moment.

    For example: [bold]evlcp board update stm32f405-8mhz.update.json --port /dev/ttyUSB0[/]
    """
    if (file is not None) + (target is not None) + confirm != 1:
        raise ConfigError("give an update, --target to build one, or --confirm, one of the three")
    package = None if file is None else host.update.UpdatePackage.read(file)
    if target is not None:
        package = host.update.UpdatePackage.build(target)
    with open_board(context) as board:
        if package is None:
            running = host.update.update_status(board).running
            host.update.confirm_update(board)
            print_result(f"image {running} is kept", {"image": running, "kept": True}, as_json)
            return
        with progress_bar("updating") as progress:
            done = host.update.update_firmware(board, package, progress, keep)
    words = f"image {done.image} runs, {done.length} bytes, firmware {done.firmware}"
    table = {"image": done.image, "bytes": done.length, "sequence": done.sequence, "firmware": done.firmware}
    print_result(words + ("" if keep else ", on trial"), table | {"kept": keep}, as_json)
