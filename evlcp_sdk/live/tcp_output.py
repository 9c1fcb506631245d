"""Positions for other programs over TCP, as they come: NMEA-0183, and what gpsd says."""

import asyncio
import json
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
_MOST_WAITING: Final = 1000
"""Fixes that wait to be told; the oldest go."""
_MOST_BYTES: Final = 1 << 18
"""What waits for a client, beside what the kernel holds; more is not sent to it, and counted."""
_MOST_CLIENTS: Final = 32
_MOST_LINE: Final = 4096
_KERNEL_BYTES: Final = 1 << 16
"""What the kernel holds for a client: what waits there is old."""


class TcpOutput(Server):
    """Serves positions over TCP.

    Where the UTC of the camera's clock is not known, the computer's clock says it, once: programs that read
    positions want a time.

    Args:
        publisher: Where fixes come from.
        gpsd: As gpsd's JSON, to clients that say `?WATCH`; or else NMEA, to whoever connects.
        port: Where to listen, on this machine only; 0 for any that is free.
        clock_zero: UTC of the camera clock's 0; None if it is not known.
    """

    def __init__(
        self, publisher: Publisher, *, gpsd: bool, port: int = 0, clock_zero: ClockZero = None
    ) -> None:
        self._loop: asyncio.AbstractEventLoop | None = None
        self._came = asyncio.Event()
        super().__init__(publisher, _KINDS, _MOST_WAITING, _HOST, port, self._wake)
        self._gpsd, self._zero = gpsd, clock_zero
        self._clients: dict[asyncio.StreamWriter, dict[str, Any]] = {}
        self._newest: dict[str, dict[str, Any]] = {}

    @property
    def url(self) -> str:
        """Address and port."""
        return f"{self._host}:{self.port}"

    def _wake(self) -> None:
        # The loop may be over before the receiver is.
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._came.set)

    async def _listen(self) -> asyncio.Server:
        self._loop = asyncio.get_running_loop()
        # Something may have come already.
        self._came.set()
        return await asyncio.start_server(self._serve, self._host, self.port, limit=_MOST_LINE)

    async def _tell_all(self) -> None:
        while not self._mine.ended:
            await self._came.wait()
            self._came.clear()
            for news in self._mine.take(0):
                self._tell(news)

    def _abort(self) -> None:
        return

    def _tell(self, news: News) -> None:
        if self._zero is None:
            self._zero = datetime.now(UTC) - timedelta(microseconds=news.t_us)
        if news.kind != "fix" or not (self._clients or self._gpsd):
            return
        fix, place = news.value.fix, news.value.filtered
        zero = clock_zero_at(self._zero, fix.t_us)
        text = b""
        if any(watch["nmea"] for watch in self._clients.values()):
            text = format_sentences(fix, place, zero).encode("ascii", "replace")
        told = b""
        if self._gpsd:
            self._newest = {"TPV": tpv(fix, place, zero), "SKY": sky(fix, zero)}
            told = b"".join(_line(report) for report in self._newest.values())
        for writer, watch in self._clients.items():
            if watch["enable"]:
                self._put(writer, (told if watch["json"] else b"") + (text if watch["nmea"] else b""))

    def _put(self, writer: asyncio.StreamWriter, data: bytes) -> None:
        """Send something to a client, unless too much waits for it."""
        if writer.transport.get_write_buffer_size() > _MOST_BYTES:
            self._unsent += 1
        else:
            writer.write(data)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve one client until it leaves."""
        if len(self._clients) >= _MOST_CLIENTS:
            writer.close()
            return
        watch = {"enable": not self._gpsd, "json": False, "nmea": not self._gpsd}
        if self._gpsd:
            self._put(writer, _line(VERSION))
        self._clients[writer] = watch
        try:
            writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _KERNEL_BYTES)
            while line := await reader.readline():
                if self._gpsd:
                    for request in line.decode("utf-8", "replace").split(";"):
                        if request.strip():
                            for said in answer_request(request, watch, self._newest):
                                self._put(writer, _line(said))
        except (OSError, ValueError, asyncio.CancelledError):
            pass  # It has gone, sends no lines, or the run is over.
        finally:
            del self._clients[writer]
            writer.transport.abort()


def _line(report: dict[str, Any]) -> bytes:
    return json.dumps(report, separators=(",", ":")).encode() + b"\r\n"
