"""The web view in a process of its own: the receiver's process only hands results and pictures on."""

import asyncio
import contextlib
import multiprocessing
import select
import signal
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, Final
from urllib.parse import urlsplit

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.live.desk import Desk
from evlcp_sdk.live.recorder import Recorder
from evlcp_sdk.live.telling import MOST_WAITING, PICTURES_PER_S, Line, Shot, Teller
from evlcp_sdk.live.viewer import Viewer

__all__ = ["ViewerApart"]

_UNASKED: Final = 5
"""Bundles from the receiver's process after which it draws no more, as nobody asks for a picture."""

_BEGIN_S: Final = 60.0
_END_S: Final = 3.0


class ViewerApart:
    """A `Viewer` in a process of its own, fed by a thread of this one.

    The thread may wait for that process, the receiver never does: of what is too much the oldest goes. What
    is shown is drawn here, as a picture is less than its events, and written out there, as values take less
    to hand on than to write. Arguments are those of `Viewer`.

    Attributes:
        url: What to open in a browser, once started.
    """

    def __init__(
        self,
        feed: Teller,
        links: Mapping[str, Link],
        *,
        name: str,
        sites: int = 0,
        host: str = "127.0.0.1",
        port: int = 0,
        recorder: Recorder | None = None,
    ) -> None:
        self._teller, self._recorder = feed, recorder
        self._given = (dict(links), name, sites, host, port, recorder is not None)
        self._told = 0
        self.url = ""

    @property
    def port(self) -> int:
        """Where it listens, once started."""
        return urlsplit(self.url).port or 0

    @property
    def dropped(self) -> int:
        """Results that browsers were not sent as they did not take them, or as there was no time, so far."""
        return self._told + self._teller.dropped

    async def start(self) -> None:
        """Start the process, and wait until it listens.

        Raises:
            ConfigError: The port cannot be had, or the package `websockets` is not installed.
        """
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, *self._given), daemon=True)
        self._process.start()
        theirs.close()
        try:
            late = "fault", "the process of the view does not start"
            told, text = self._pipe.recv() if self._pipe.poll(_BEGIN_S) else late
        except EOFError:
            told, text = "fault", "the process of the view has ended"
        if told == "fault":
            self._teller.leave()
            raise ConfigError(text)
        self.url = text
        self._thread = threading.Thread(target=self._feed, name="evlcp-view", daemon=True)
        self._thread.start()

    async def finish(self) -> None:
        """Wait until browsers have had the last words, a moment at the most."""
        await asyncio.to_thread(self._thread.join, _END_S)
        await asyncio.to_thread(self._process.join, _END_S)
        if self._process.is_alive():
            self._process.kill()

    def _feed(self) -> None:
        """Hand on what comes, and do what is asked, until all is said or the process has gone."""
        said = select.poll()
        said.register(self._pipe.fileno(), select.POLLIN)
        number, wanted, turn_s = -1, False, time.monotonic()
        with contextlib.suppress(OSError, EOFError):
            while True:
                ended = self._teller.ended
                # At even times, unless they are over already: one wake-up a picture.
                now_s = time.monotonic()
                turn_s = max(turn_s + 1 / PICTURES_PER_S, now_s)
                while said.poll(0.0 if ended else max(0.0, turn_s - time.monotonic()) * 1e3):
                    kind, value = self._pipe.recv()
                    if kind == "wanted":
                        wanted = value
                    elif kind == "dropped":
                        self._told = value
                    elif self._recorder is not None:
                        (self._recorder.start if value else self._recorder.stop)()
                shot = self._teller.shot() if wanted else None
                if shot is not None and shot.number == number:
                    shot = None
                if shot is not None:
                    number = shot.number
                if wanted:
                    self._teller.ask()
                state = None if self._recorder is None else self._recorder.state
                self._pipe.send((self._teller.take(frames=True), shot, state))
                if ended:
                    self._pipe.send(None)
                    break
        self._teller.leave()


class _Wire:
    """The child's end of the pipe, for any of its threads."""

    def __init__(self, pipe: Any) -> None:
        self.pipe = pipe
        self._lock = threading.Lock()

    def say(self, kind: str, value: Any = None) -> None:
        """Tell the receiver's process something; nothing where that has gone."""
        with self._lock, contextlib.suppress(OSError):
            self.pipe.send((kind, value))


class _FarFeed:
    """What the receiver's process tells, as it comes; has pictures drawn while somebody asks for them."""

    def __init__(self, wire: _Wire, loop: asyncio.AbstractEventLoop) -> None:
        self._wire, self._loop = wire, loop
        self._came = asyncio.Event()
        self._wanted = self._over = False
        self._unasked = 0
        self._waiting: deque[Line] = deque(maxlen=MOST_WAITING)
        self._lock = threading.Lock()
        self._shot: Shot | None = None
        self.dropped = 0

    @property
    def ended(self) -> bool:
        """Nothing more will come, and nothing is left."""
        return self._over and not self._waiting

    async def turn(self) -> None:
        """Wait until something has come."""
        await self._came.wait()
        self._came.clear()

    def take(self, *, frames: bool) -> list[Line]:
        """What has come; frames are told in any case, as a browser may have come since."""
        with self._lock:
            lines = list(self._waiting)
            self._waiting.clear()
        return lines

    def shot(self) -> Shot | None:
        """The last picture that came."""
        return self._shot

    def ask(self) -> None:
        """Have pictures drawn, until nobody has asked for some time."""
        self._unasked = 0
        self._want(True)

    def _want(self, wanted: bool) -> None:
        if wanted != self._wanted:
            self._wanted = wanted
            self._wire.say("wanted", wanted)

    def put(self, lines: Sequence[Line], shot: Shot | None) -> None:
        """Keep what has come."""
        with self._lock:
            self.dropped += max(len(self._waiting) + len(lines) - MOST_WAITING, 0)
            self._waiting.extend(lines)
        if shot is not None:
            self._shot = shot
        self._loop.call_soon_threadsafe(self._arrived)

    def _arrived(self) -> None:
        self._unasked += 1
        if self._unasked > _UNASKED:
            self._want(False)
        self._came.set()

    def leave(self) -> None:
        """Nothing more will come."""
        self._over = True
        with contextlib.suppress(RuntimeError):  # the loop may be closed
            self._loop.call_soon_threadsafe(self._came.set)


class _FarRecorder:
    """Has the receiver's process record."""

    def __init__(self, wire: _Wire) -> None:
        self._wire = wire
        self.state: dict[str, Any] = {}

    def start(self) -> None:
        """Begin a file."""
        self._wire.say("record", True)

    def stop(self) -> None:
        """End the file."""
        self._wire.say("record", False)


def _serve(
    pipe: Any,
    links: Mapping[str, Link],
    name: str,
    sites: int,
    host: str,
    port: int,
    may_record: bool,
) -> None:
    """Serve the view in this process until all is said, or the receiver's process has gone."""
    # Ctrl-C is for the receiver, which ends this.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    wire = _Wire(pipe)
    recorder = _FarRecorder(wire) if may_record else None
    with Desk() as desk:
        feed = _FarFeed(wire, desk.loop)
        viewer = Viewer(feed, links, name=name, sites=sites, host=host, port=port, recorder=recorder)
        try:
            desk.call(viewer.start())
        except ConfigError as fault:
            wire.say("fault", str(fault))
            return
        wire.say("url", viewer.url)
        dropped = 0
        with contextlib.suppress(OSError, EOFError):
            while (told := pipe.recv()) is not None:
                lines, shot, state = told
                feed.put(lines, shot)
                if recorder is not None:
                    recorder.state = state
                if viewer.dropped != dropped:
                    dropped = viewer.dropped
                    wire.say("dropped", dropped)
        feed.leave()
        desk.call(viewer.finish())
