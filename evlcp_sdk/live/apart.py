"""The web view in a process of its own: the receiver's process only hands results and pictures on."""

import asyncio
import contextlib
import multiprocessing
import signal
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any, Final
from urllib.parse import urlsplit

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.live.desk import Desk
from evlcp_sdk.live.outlet import Outlet
from evlcp_sdk.live.pictures import Picture, PictureSlot
from evlcp_sdk.live.recorder import Recorder
from evlcp_sdk.live.viewer import KINDS_SHOWN, MOST_WAITING, PICTURES_PER_S, Viewer
from evlcp_sdk.scene.sites import BarSite

__all__ = ["ViewerApart"]

_TURN_S: Final = 0.01
_BEGIN_S: Final = 60.0
_END_S: Final = 3.0


class ViewerApart:
    """A `Viewer` in a process of its own, fed by a thread of this one.

    The thread may wait for that process, the receiver never does: of what is too much the oldest goes.
    Arguments are those of `Viewer`.

    Attributes:
        url: What to open in a browser, once started.
    """

    def __init__(
        self,
        outlet: Outlet,
        pictures: PictureSlot,
        links: Mapping[str, Link],
        *,
        name: str,
        sites: Sequence[BarSite] = (),
        host: str = "127.0.0.1",
        port: int = 0,
        recorder: Recorder | None = None,
    ) -> None:
        self._outlet, self._pictures, self._recorder = outlet, pictures, recorder
        self._given = (dict(links), name, tuple(sites), host, port, recorder is not None)
        self._mine = outlet.subscribe(KINDS_SHOWN, most=MOST_WAITING)
        self._told = 0
        self.url = ""

    @property
    def port(self) -> int:
        """Where it listens, once started."""
        return urlsplit(self.url).port or 0

    @property
    def dropped(self) -> int:
        """Results that browsers were not sent as they did not take them, or as there was no time, so far."""
        return self._told + self._mine.dropped

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
            self._outlet.leave(self._mine)
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
                ended = self._mine.ended
                if self._pipe.poll(0.0 if ended else _TURN_S):
                    kind, value = self._pipe.recv()
                    if kind == "ask":
                        wanted = True
                        self._pictures.ask()
                    elif kind == "dropped":
                        self._told = value
                    elif self._recorder is not None:
                        (self._recorder.start if value else self._recorder.stop)()
                picture = self._pictures.newest if wanted else None
                if picture is not None and picture.number == number:
                    picture = None
                now_s = time.monotonic()
                if picture is None and not ended and now_s < told_s + 1 / PICTURES_PER_S:
                    continue
                if picture is not None:
                    number, wanted = picture.number, False
                told_s = now_s
                state = None if self._recorder is None else self._recorder.state
                self._pipe.send((self._mine.take(0), picture, state))
                if ended:
                    self._pipe.send(None)
                    break
        self._outlet.leave(self._mine)


class _Wire:
    """The child's end of the pipe, for any of its threads."""

    def __init__(self, pipe: Any) -> None:
        self.pipe = pipe
        self._lock = threading.Lock()

    def say(self, kind: str, value: Any = None) -> None:
        """Tell the receiver's process something; nothing where that has gone."""
        with self._lock, contextlib.suppress(OSError):
            self.pipe.send((kind, value))


class _FarPictures:
    """Asks the receiver's process for pictures, one at a time."""

    def __init__(self, wire: _Wire) -> None:
        self._wire = wire
        self._asked = False
        self._newest: Picture | None = None

    @property
    def newest(self) -> Picture | None:
        """The last picture that came."""
        return self._newest

    def ask(self) -> None:
        """Have a picture drawn, where none is under way."""
        if not self._asked:
            self._asked = True
            self._wire.say("ask")

    def take(self, picture: Picture) -> None:
        """Keep a picture that has come."""
        self._newest, self._asked = picture, False


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
    sites: tuple[BarSite, ...],
    host: str,
    port: int,
    may_record: bool,
) -> None:
    """Serve the view in this process until all is said, or the receiver's process has gone."""
    # Ctrl-C is for the receiver, which ends this.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    wire, outlet = _Wire(pipe), Outlet()
    pictures, recorder = _FarPictures(wire), _FarRecorder(wire) if may_record else None
    viewer = Viewer(outlet, pictures, links, name=name, sites=sites, host=host, port=port, recorder=recorder)
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
                news, picture, state = told
                for one in news:
                    outlet.publish(one.kind, one.t_us, one.value, one.late_ms)
                if picture is not None:
                    pictures.take(picture)
                if recorder is not None:
                    recorder.state = state
                if viewer.dropped != dropped:
                    dropped = viewer.dropped
                    wire.say("dropped", dropped)
        outlet.close()
        desk.call(viewer.finish())
