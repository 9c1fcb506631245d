"""The web view in a process of its own: the receiver's process only hands results and pictures on."""

import asyncio
import contextlib
import multiprocessing
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
from evlcp_sdk.live.telling import MOST_WAITING, Line, Shot, Teller
from evlcp_sdk.live.viewer import PICTURES_PER_S, Viewer

__all__ = ["ViewerApart"]

_TURN_S: Final = 0.01
_BEGIN_S: Final = 60.0
_END_S: Final = 3.0


class ViewerApart:
    """A `Viewer` in a process of its own, fed by a thread of this one.

    The thread may wait for that process, the receiver never does: of what is too much the oldest goes. What
    is shown is told here, and only then handed on: a line takes less to hand on than what it tells of.
    Arguments are those of `Viewer`.

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
        number, wanted, told_s = -1, False, 0.0
        with contextlib.suppress(OSError, EOFError):
            while True:
                ended = self._teller.ended
                rest_s = told_s + 1 / PICTURES_PER_S - time.monotonic()
                if self._pipe.poll(0.0 if ended else max(0.0, min(rest_s, _TURN_S if wanted else rest_s))):
                    kind, value = self._pipe.recv()
                    if kind == "ask":
                        wanted = True
                        self._teller.ask()
                    elif kind == "dropped":
                        self._told = value
                    elif self._recorder is not None:
                        (self._recorder.start if value else self._recorder.stop)()
                shot = self._teller.shot() if wanted else None
                if shot is not None and shot.number == number:
                    shot = None
                now_s = time.monotonic()
                if shot is None and not ended and now_s < told_s + 1 / PICTURES_PER_S:
                    continue
                if shot is not None:
                    number, wanted = shot.number, False
                told_s = now_s
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
    """What the receiver's process tells, as it comes; asks for pictures, one at a time."""

    def __init__(self, wire: _Wire) -> None:
        self._wire = wire
        self._asked = self._over = False
        self._waiting: deque[Line] = deque(maxlen=MOST_WAITING)
        self._lock = threading.Lock()
        self._shot: Shot | None = None
        self.dropped = 0

    @property
    def ended(self) -> bool:
        """Nothing more will come, and nothing is left."""
        return self._over and not self._waiting

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
        """Have a picture drawn, where none is under way."""
        if not self._asked:
            self._asked = True
            self._wire.say("ask")

    def put(self, lines: Sequence[Line], shot: Shot | None) -> None:
        """Keep what has come."""
        with self._lock:
            self.dropped += max(len(self._waiting) + len(lines) - MOST_WAITING, 0)
            self._waiting.extend(lines)
        if shot is not None:
            self._shot, self._asked = shot, False

    def leave(self) -> None:
        """Nothing more will come."""
        self._over = True


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
    feed, recorder = _FarFeed(wire), _FarRecorder(wire) if may_record else None
    viewer = Viewer(feed, links, name=name, sites=sites, host=host, port=port, recorder=recorder)
    with Desk() as desk:
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
