"""The web view of a live run: one page, and what it shows, over one WebSocket a browser.

The receiver never waits for a browser. Results wait for each browser in a bounded queue, whose oldest go,
counted; of pictures there is only the newest, drawn when a browser is ready for one. A browser is sent one
bundle, what waits and the newest picture, for each credit that it gives, which is when it has shown the
last one: one that stalls costs nothing.
"""

import asyncio
import itertools
import json
import secrets
import struct
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from http import HTTPStatus
from importlib.resources import files
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit
from weakref import WeakSet

from markupsafe import Markup

from evlcp_sdk.errors import import_extra
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.live.budget import LEVELS
from evlcp_sdk.live.publisher import Publisher
from evlcp_sdk.live.recorder import Recorder
from evlcp_sdk.live.serializer import Serializer
from evlcp_sdk.live.server import Server
from evlcp_sdk.report.colours import TRANSMITTER_COLOURS, cluster_hex
from evlcp_sdk.report.pages import TEMPLATES, render_page
from evlcp_sdk.scene.sites import BarSite

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

_KINDS: Final = frozenset({"frame", "message", "fix", "status", "end"})
_PICTURES_PER_S: Final = 25
_MOST_WAITING: Final = 4000
"""Results that wait for a browser, some seconds of two bars; the oldest go."""
_MOST_BROWSERS: Final = 16
_MOST_SAID: Final = 4096
"""Bytes of what a browser says."""
_KEPT: Final = {"message": 50, "fix": 500}
"""What a browser that comes later is shown of what was before; of other kinds but frames the last one."""

_HEADERS: Final = {
    "Content-Type": "text/html; charset=utf-8",
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
"""Of the page."""


@dataclass(eq=False)
class _Browser:
    """One that looks on.

    Attributes:
        socket: Its connection.
        waiting: Results that it has not been sent, as JSON, the newest.
        dropped: How many of them were pushed out.
        ready: It has shown what it was sent.
        picture: Number of the picture that it has.
    """

    socket: "ServerConnection"
    waiting: deque[str] = field(default_factory=lambda: deque(maxlen=_MOST_WAITING))
    dropped: int = 0
    ready: bool = False
    picture: int = -1

    def put(self, line: str) -> bool:
        """Have something sent; whether the oldest has gone for it, as the queue was full."""
        full = len(self.waiting) == self.waiting.maxlen
        self.dropped += full
        self.waiting.append(line)
        return full


class Viewer(Server):
    """Serves the page and what it shows.

    Args:
        publisher: Where results and pictures come from.
        links: The configurations by name, as `name_links` gives them.
        name: Name of the source, for the title.
        sites: Where the bars stand, for the map.
        host: Where to listen: of this machine only, unless it is another address of it.
        port: The same; 0 for any that is free.
        recorder: Starts and stops recordings as a browser asks; None: browsers only look on.
    """

    def __init__(
        self,
        publisher: Publisher,
        links: Mapping[str, Link],
        *,
        name: str,
        sites: Sequence[BarSite] = (),
        host: str = "127.0.0.1",
        port: int = 0,
        recorder: Recorder | None = None,
    ) -> None:
        super().__init__(publisher, _KINDS, _MOST_WAITING, host, port)
        self._recorder = recorder
        self._serializer = Serializer(links, sites)
        self._name, self._links, self._sites = name, links, len(sites)
        self._token = secrets.token_urlsafe(16)
        self._browsers: set[_Browser] = set()
        self._opened: WeakSet[ServerConnection] = WeakSet()
        self._kept = {kind: deque[str](maxlen=most) for kind, most in _KEPT.items()}
        self._page = ""

    @property
    def url(self) -> str:
        """What to open in a browser; who has it may look on."""
        host = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(self._host, self._host)
        return f"http://{host}:{self.port}/{self._token}/"

    async def _listen(self) -> Any:
        websockets = import_extra("websockets.asyncio.server", "live")

        def opened(*given: Any, **options: Any) -> "ServerConnection":
            connection: ServerConnection = websockets.ServerConnection(*given, **options)
            self._opened.add(connection)
            return connection

        self._page = page(self._name)
        given = {"compression": None, "max_size": _MOST_SAID, "server_header": None}
        asked = {"process_request": self._answer, "create_connection": opened}
        return await websockets.serve(self._serve, self._host, self.port, **given, **asked)

    def _abort(self) -> None:
        # A browser opens connections that it may need: their handshake, cancelled, would leave them open.
        for connection in self._opened:
            if connection.request is None:
                connection.transport.abort()

    async def _tell_all(self) -> None:
        loop, turn_s = asyncio.get_running_loop(), 0.0
        while not self._mine.ended:
            # At even times, unless they are over already.
            now_s = loop.time()
            turn_s = max(turn_s + 1 / _PICTURES_PER_S, now_s)
            await asyncio.sleep(turn_s - now_s)
            for news in self._mine.take(0):
                for kind, line in self._serializer.lines(news, frames=bool(self._browsers)):
                    self._tell(kind, line)
            self._send_all()
        # The last words, once a browser has shown what it was sent before.
        await asyncio.sleep(2 / _PICTURES_PER_S)
        self._send_all()
        while any(browser.waiting for browser in self._browsers):
            await asyncio.sleep(1 / _PICTURES_PER_S)
            self._send_all()

    # What browsers ask for

    def _answer(self, connection: "ServerConnection", request: "Request") -> "Response | None":
        """Give the page, let a WebSocket through, or refuse."""
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        given, _, rest = urlsplit(request.path).path.removeprefix("/").partition("/")
        why = ""
        if len(hosts) != 1 or not self._is_ours(hosts[0]):
            why = "this server is known by another name"
        elif origins not in ([], [f"http://{hosts[0]}"]):
            why = "the page of another server may not look on"
        elif not secrets.compare_digest(given.encode(), self._token.encode()):
            why = "expected the address that the run has printed, with its key"
        if why:
            return connection.respond(HTTPStatus.FORBIDDEN, f"{why}\n")
        if rest == "live":
            if len(self._browsers) >= _MOST_BROWSERS:
                return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "too many browsers look on\n")
            return None
        if rest:
            return connection.respond(HTTPStatus.NOT_FOUND, "nothing is here\n")
        response = connection.respond(HTTPStatus.OK, self._page)
        del response.headers["Content-Type"]
        response.headers.update(_HEADERS)
        return response

    def _is_ours(self, host: str) -> bool:
        """Whether a request was meant for this server: names of others may point to our address."""
        try:
            parts = urlsplit(f"//{host}")
            name, port = parts.hostname or "", parts.port or 80
        except ValueError:
            return False
        if port != self.port or parts.username is not None:
            return False
        if name in ("localhost", self._host):
            return True
        try:
            return ip_address(name).is_loopback or self._host in ("0.0.0.0", "::")
        except ValueError:
            return False

    async def _serve(self, socket: "ServerConnection") -> None:
        """Serve one browser until it leaves."""
        from websockets.exceptions import ConnectionClosed

        browser = _Browser(socket)
        browser.waiting.extend(itertools.chain.from_iterable(self._kept.values()))
        self._browsers.add(browser)
        try:
            await socket.send(json.dumps(self._about()))
            async for request in socket:
                if not self._take_request(browser, request):
                    await socket.close(1008, "not understood")
        except ConnectionClosed:
            pass  # It has gone.
        except asyncio.CancelledError:
            socket.transport.abort()
            raise
        finally:
            self._browsers.discard(browser)

    def _take_request(self, browser: _Browser, request: str | bytes) -> bool:
        """Do what a browser asks for, if it may; whether that was understood."""
        try:
            asked = json.loads(request)
        except ValueError:
            return False
        if asked == {"next": True}:
            browser.ready = True
        elif self._recorder is not None and asked == {"record": True}:
            self._recorder.start()
        elif self._recorder is not None and asked == {"record": False}:
            self._recorder.stop()
        else:
            return False
        return True

    def _about(self) -> dict[str, Any]:
        """What a browser is sent first."""
        return {
            "about": {
                "name": self._name,
                "run": self._token[:6],
                "links": {
                    name: {
                        "symbols": 2**link.codebook.bits_per_symbol,
                        "cluster_colours": cluster_hex(link.codebook.clusters),
                    }
                    for name, link in self._links.items()
                },
                "colours": list(TRANSMITTER_COLOURS),
                "levels": list(LEVELS),
                "sites": self._sites,
                "may_record": self._recorder is not None,
            }
        }

    # What browsers are sent

    def _tell(self, kind: str, line: str) -> None:
        """Send something to all browsers, and keep what later ones are sent."""
        if kind != "frame":
            self._kept.setdefault(kind, deque(maxlen=1)).append(line)
        for browser in self._browsers:
            self._unsent += browser.put(line)

    def _send_all(self) -> None:
        """Send a bundle to each browser that is ready for one."""
        ready = [browser for browser in self._browsers if browser.ready]
        if not ready:
            return
        from websockets.asyncio.server import broadcast

        picture = self._publisher.pictures.newest
        self._publisher.pictures.ask()
        record = None if self._recorder is None else self._recorder.state
        end = f'"record": {json.dumps(record)}}}'
        for browser in ready:
            told, data = '"picture": null, "bars": null', b""
            if picture is not None and browser.picture != picture.number:
                browser.picture = picture.number
                told, data = self._serializer.shot(picture)
            elif not browser.waiting:
                continue
            dropped = browser.dropped + self._mine.dropped
            text = f'{{"news": [{", ".join(browser.waiting)}], "dropped": {dropped}, {told}, {end}'.encode()
            browser.waiting.clear()
            browser.ready = False
            # It waits for nothing: of one that does not read there is no second bundle under way.
            broadcast([browser.socket], struct.pack("<I", len(text)) + text + data)


def page(name: str) -> str:
    """The page: HTML with all that it needs in it."""
    here = files("evlcp_sdk.live")
    read: Mapping[str, str] = {
        part: here.joinpath(*part.split("/")).read_text("utf-8")
        for part in ("page.html", "page.js", "page.css", "uplot/uPlot.js", "uplot/uPlot.css")
    }
    return render_page(
        TEMPLATES.from_string(read["page.html"]),
        f"{name} - live",
        [read["uplot/uPlot.js"], read["page.js"]],
        connect=True,
        name=name,
        style=Markup(read["uplot/uPlot.css"] + read["page.css"]),
    )
