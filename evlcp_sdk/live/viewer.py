"""The web view of a live run: one page, and its data, over one WebSocket a browser.

The receiver never waits for a browser. Results wait for each browser in a bounded queue that drops the
oldest, counted; of pictures there is only the newest, drawn when a browser is ready for one. A browser gets
one bundle, the waiting results and the newest picture, for each credit that it gives when it has shown the
last one: a stalled browser costs nothing.
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
_MAX_WAITING: Final = 4000
"""Results that may wait for a browser, some seconds of two bars; beyond, the oldest are dropped."""
_MAX_BROWSERS: Final = 16
_MAX_REQUEST_BYTES: Final = 4096
_HISTORY: Final = {"message": 50, "fix": 500}
"""Earlier results that a new browser gets; of other kinds but frames the last one."""

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
    """A connected browser.

    Attributes:
        waiting: The newest results that it has not got, as JSON.
        dropped: Number of results that newer ones have pushed out.
        ready: It has shown the last bundle.
        picture: Number of its picture.
    """

    socket: "ServerConnection"
    waiting: deque[str] = field(default_factory=lambda: deque(maxlen=_MAX_WAITING))
    dropped: int = 0
    ready: bool = False
    picture: int = -1

    def enqueue(self, line: str) -> bool:
        """Add a line to the queue; whether it was full and has dropped the oldest."""
        full = len(self.waiting) == self.waiting.maxlen
        self.dropped += full
        self.waiting.append(line)
        return full


class Viewer(Server):
    """Serves the page and its data; other machines reach it only at another `host` than the default.

    A browser may start and stop recordings if there is a `recorder`; `sites` are for the map, and `links` are
    the configurations by name, as `name_links` gives them.
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
        super().__init__(publisher, _KINDS, _MAX_WAITING, host, port)
        self._recorder = recorder
        self._serializer = Serializer(links, sites)
        self._name, self._links, self._sites = name, links, len(sites)
        self._token = secrets.token_urlsafe(16)
        self._browsers: set[_Browser] = set()
        self._connections: WeakSet[ServerConnection] = WeakSet()
        self._history = {kind: deque[str](maxlen=most) for kind, most in _HISTORY.items()}
        self._page = ""

    @property
    def url(self) -> str:
        """Address for a browser; whoever has it may watch."""
        host = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(self._host, self._host)
        return f"http://{host}:{self.port}/{self._token}/"

    async def _listen(self) -> Any:
        websockets = import_extra("websockets.asyncio.server", "live")

        def create_connection(*args: Any, **options: Any) -> "ServerConnection":
            connection: ServerConnection = websockets.ServerConnection(*args, **options)
            self._connections.add(connection)
            return connection

        self._page = render_viewer_page(self._name)
        options = {"compression": None, "max_size": _MAX_REQUEST_BYTES, "server_header": None}
        hooks = {"process_request": self._answer_request, "create_connection": create_connection}
        return await websockets.serve(self._serve, self._host, self.port, **options, **hooks)

    def _abort(self) -> None:
        # A browser opens spare connections: a cancelled handshake would leave them open.
        for connection in self._connections:
            if connection.request is None:
                connection.transport.abort()

    async def _send_news(self) -> None:
        loop, next_s = asyncio.get_running_loop(), 0.0
        while not self._subscription.ended:
            # At regular times, as far as they are not over.
            now_s = loop.time()
            next_s = max(next_s + 1 / _PICTURES_PER_S, now_s)
            await asyncio.sleep(next_s - now_s)
            for news in self._subscription.take(0):
                for kind, line in self._serializer.serialize(news, frames=bool(self._browsers)):
                    self._enqueue(kind, line)
            self._send_bundles()
        # The rest, once a browser has shown the bundle before.
        await asyncio.sleep(2 / _PICTURES_PER_S)
        self._send_bundles()
        while any(browser.waiting for browser in self._browsers):
            await asyncio.sleep(1 / _PICTURES_PER_S)
            self._send_bundles()

    # Requests of browsers

    def _answer_request(self, connection: "ServerConnection", request: "Request") -> "Response | None":
        """Return the page, let a WebSocket through, or refuse."""
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        token, _, rest = urlsplit(request.path).path.removeprefix("/").partition("/")
        reason = ""
        if len(hosts) != 1 or not self._is_ours(hosts[0]):
            reason = "this server is known by another name"
        elif origins not in ([], [f"http://{hosts[0]}"]):
            reason = "the page of another server may not look on"
        elif not secrets.compare_digest(token.encode(), self._token.encode()):
            reason = "expected the address that the run has printed, with its key"
        if reason:
            return connection.respond(HTTPStatus.FORBIDDEN, f"{reason}\n")
        if rest == "live":
            if len(self._browsers) >= _MAX_BROWSERS:
                return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "too many browsers look on\n")
            return None
        if rest:
            return connection.respond(HTTPStatus.NOT_FOUND, "nothing is here\n")
        response = connection.respond(HTTPStatus.OK, self._page)
        del response.headers["Content-Type"]
        response.headers.update(_HEADERS)
        return response

    def _is_ours(self, host: str) -> bool:
        """Whether a request is meant for this server: names of others may point to its address."""
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
        from websockets.exceptions import ConnectionClosed

        browser = _Browser(socket)
        browser.waiting.extend(itertools.chain.from_iterable(self._history.values()))
        self._browsers.add(browser)
        try:
            await socket.send(json.dumps(self._describe_run()))
            async for request in socket:
                if not self._handle_request(browser, request):
                    await socket.close(1008, "not understood")
        except ConnectionClosed:
            pass  # It has gone.
        except asyncio.CancelledError:
            socket.transport.abort()
            raise
        finally:
            self._browsers.discard(browser)

    def _handle_request(self, browser: _Browser, request: str | bytes) -> bool:
        """Handle a request of a browser; whether it is known and allowed."""
        try:
            command = json.loads(request)
        except ValueError:
            return False
        if command == {"next": True}:
            browser.ready = True
        elif self._recorder is not None and command == {"record": True}:
            self._recorder.start()
        elif self._recorder is not None and command == {"record": False}:
            self._recorder.stop()
        else:
            return False
        return True

    def _describe_run(self) -> dict[str, Any]:
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

    # Messages to browsers

    def _enqueue(self, kind: str, line: str) -> None:
        """Add a line to the queues of all browsers, and to the history for later ones."""
        if kind != "frame":
            self._history.setdefault(kind, deque(maxlen=1)).append(line)
        for browser in self._browsers:
            self._unsent += browser.enqueue(line)

    def _send_bundles(self) -> None:
        ready = [browser for browser in self._browsers if browser.ready]
        if not ready:
            return
        from websockets.asyncio.server import broadcast

        picture = self._publisher.pictures.newest
        self._publisher.pictures.request()
        record = None if self._recorder is None else self._recorder.state
        end = f'"record": {json.dumps(record)}}}'
        for browser in ready:
            members, data = '"picture": null, "bars": null', b""
            if picture is not None and browser.picture != picture.number:
                browser.picture = picture.number
                members, data = self._serializer.serialize_picture(picture)
            elif not browser.waiting:
                continue
            dropped = browser.dropped + self._subscription.dropped
            text = (
                f'{{"news": [{", ".join(browser.waiting)}], "dropped": {dropped}, {members}, {end}'.encode()
            )
            browser.waiting.clear()
            browser.ready = False
            # This does not wait: a browser that does not read has no second bundle under way.
            broadcast([browser.socket], struct.pack("<I", len(text)) + text + data)


def render_viewer_page(name: str) -> str:
    """The page: HTML with all its parts."""
    folder = files("evlcp_sdk.live")
    parts: Mapping[str, str] = {
        part: folder.joinpath(*part.split("/")).read_text("utf-8")
        for part in ("page.html", "page.js", "page.css", "uplot/uPlot.js", "uplot/uPlot.css")
    }
    return render_page(
        TEMPLATES.from_string(parts["page.html"]),
        f"{name} - live",
        [parts["uplot/uPlot.js"], parts["page.js"]],
        connect=True,
        name=name,
        style=Markup(parts["uplot/uPlot.css"] + parts["page.css"]),
    )
