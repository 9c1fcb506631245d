"""`evlcp serve`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._stderr import print_stderr
from evlcp_sdk.signals import stop_on_request


def serve(
    url: Annotated[
        str, typer.Argument(metavar="URL", help="A recording, which is sent at its own pace, or a camera.")
    ],
    tcp: Annotated[
        str | None,
        typer.Option(metavar="[HOST:]PORT", help="Listen there; this machine only without a host."),
    ] = None,
    unix: Annotated[Path | None, typer.Option(metavar="PATH", help="Listen on a Unix socket, too.")] = None,
) -> None:
    """Send a recording or a camera to other programs: EVT3 by socket.

    A recording, at its own pace:  [bold]evlcp serve REC.raw --tcp 5600[/]
    The other end:                 [bold]evlcp live tcp://localhost:5600[/]
    To other machines, too:        [bold]evlcp serve URL --tcp 0.0.0.0:5600[/]
    Again and again:               [bold]evlcp serve 'replay:REC.raw?loop=1' --tcp 5600[/]

    A recording begins when somebody has connected. Nothing is encrypted, and whoever can connect gets all.
    """
    address = None if tcp is None else _parse_address(tcp)
    if address is None and unix is None:
        raise typer.BadParameter("give --tcp PORT, or --unix PATH", param_hint="--tcp")
    with (
        stop_on_request() as stopped,
        sdk.interruptible.open_until_stopped(url, sdk.registry.Registry.load(), stopped) as opened,
    ):
        source = opened if opened.live else sdk.replay.ReplaySource(opened)
        with sdk.sender.Sender(source, address, unix) as sender:
            if address is not None:
                print_stderr(f"sending {url} to whoever connects to tcp://{address[0]}:{sender.port}")
            if unix is not None:
                print_stderr(f"sending {url} to whoever connects to unix:{unix}")
            if isinstance(source, sdk.replay.ReplaySource) and not sender.wait(stopped):
                return
            try:
                sender.run(stopped)
            finally:
                if dropped := sender.counts["pieces_dropped"]:
                    print_stderr(f"{dropped} pieces dropped: who received them was too slow")


def _parse_address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not (port.isascii() and port.isdigit() and int(port) < 65536):
        raise typer.BadParameter(f"{text!r}: expected PORT or HOST:PORT", param_hint="--tcp")
    return host.strip("[]") or "127.0.0.1", int(port)
