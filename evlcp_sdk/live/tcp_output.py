"""Positions for other programs over TCP, as they come: NMEA-0183, and gpsd's JSON."""

import asyncio
import json
import math
import socket
from datetime import UTC, datetime, timedelta
from typing import Any, Final

from evlcp_sdk.live.publisher import News, Publisher
from evlcp_sdk.live.server import Server
from evlcp_sdk.results.gpsd import VERSION, answer_request, sky, tpv
from evlcp_sdk.results.nmea import format_sentences
from evlcp_sdk.utc import ClockZero, clock_zero_at

_HOST: Final = "127.0.0.1"
_KINDS: Final = frozenset({"fix", "status"})
_MAX_WAITING: Final = 1000
"""Fixes that may wait; beyond, the oldest are dropped."""
_MAX_UNSENT_BYTES: Final = 1 << 18
"""Waiting for a client, besides the kernel's; more is not sent to it, but counted."""
_MAX_CLIENTS: Final = 32
_RESTART_US: Final = 1e6
"""A greater step back of time is a restart of the camera's clock; a fix comes behind its light."""
_MAX_LINE_BYTES: Final = 4096
_KERNEL_BYTES: Final = 1 << 16
"""The kernel's buffer for a client, small as its content gets old."""


class TcpOutput(Server):
    """Serves positions over TCP, on this machine only.

    As gpsd's JSON, to clients that request `?WATCH`, or else as NMEA, to every client. Where the UTC of the
    camera's clock is not known, it is taken from the computer's clock, as programs that read positions need a
    time: at the first event, and at a restart of the camera's clock.
    """

    def __init__(
        self, publisher: Publisher, *, gpsd: bool, port: int = 0, clock_zero: ClockZero = None
    ) -> None:
        self._loop: asyncio.AbstractEventLoop | None = None
        self._woken = asyncio.Event()
        super().__init__(publisher, _KINDS, _MAX_WAITING, _HOST, port, self._wake)
        self._gpsd, self._zero, self._is_given = gpsd, clock_zero, clock_zero is not None
        self._last_us = math.inf
        self._clients: dict[asyncio.StreamWriter, dict[str, Any]] = {}
        self._newest: dict[str, dict[str, Any]] = {}

    @property
    def url(self) -> str:
        """Address and port."""
        return f"{self._host}:{self.port}"

    def _wake(self) -> None:
        # The loop may end before the receiver does.
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._woken.set)

    async def _listen(self) -> asyncio.Server:
        self._loop = asyncio.get_running_loop()
        # Some news may be there already.
        self._woken.set()
        return await asyncio.start_server(self._serve, self._host, self.port, limit=_MAX_LINE_BYTES)

    async def _send_news(self) -> None:
        while not self._subscription.ended:
            await self._woken.wait()
            self._woken.clear()
            for news in self._subscription.take(0):
                self._send_fix(news)

    def _send_fix(self, news: News) -> None:
        if not news.t_us:
            return  # A status before the first event.
        if not self._is_given and news.t_us < self._last_us - _RESTART_US:
            self._zero = datetime.now(UTC) - timedelta(microseconds=news.t_us)
        self._last_us = news.t_us
        if news.kind != "fix":
            return
        fix, place = news.value.fix, news.value.filtered
        zero = clock_zero_at(self._zero, fix.t_us)
        nmea = b""
        if any(watch["nmea"] for watch in self._clients.values()):
            nmea = format_sentences(fix, place, zero).encode("ascii", "replace")
        reports = b""
        if self._gpsd:
            self._newest = {"TPV": tpv(fix, place, zero), "SKY": sky(fix, zero)}
            reports = b"".join(_to_line(report) for report in self._newest.values())
        for writer, watch in self._clients.items():
            if watch["enable"]:
                self._send(writer, (reports if watch["json"] else b"") + (nmea if watch["nmea"] else b""))

    def _send(self, writer: asyncio.StreamWriter, data: bytes) -> None:
        """Send data to a client, unless it has gone, or too much waits for it."""
        if writer.transport.get_write_buffer_size() > _MAX_UNSENT_BYTES:
            self._unsent += 1
        elif not writer.is_closing():
            writer.write(data)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._clients) >= _MAX_CLIENTS:
            writer.close()
            return
        watch = {"enable": not self._gpsd, "json": False, "nmea": not self._gpsd}
        if self._gpsd:
            self._send(writer, _to_line(VERSION))
        self._clients[writer] = watch
        try:
            writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _KERNEL_BYTES)
            while line := await reader.readline():
                if self._gpsd:
                    for request in line.decode("utf-8", "replace").split(";"):
                        if request.strip():
                            for report in answer_request(request, watch, self._newest):
                                self._send(writer, _to_line(report))
        except (OSError, ValueError, asyncio.CancelledError):
            pass  # It has gone, sends no lines, or the run is over.
        finally:
            del self._clients[writer]
            writer.transport.abort()


def _to_line(report: dict[str, Any]) -> bytes:
    return json.dumps(report, separators=(",", ":")).encode() + b"\r\n"
