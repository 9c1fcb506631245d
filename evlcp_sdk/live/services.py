"""What a live run serves beside its results: the web view, NMEA and gpsd's JSON over TCP."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from evlcp_sdk.link.resolve import Link
from evlcp_sdk.live.publisher import Publisher
from evlcp_sdk.live.recorder import Recorder
from evlcp_sdk.live.server import LoopThread
from evlcp_sdk.live.tcp_output import TcpOutput
from evlcp_sdk.live.viewer import Viewer
from evlcp_sdk.scene.sites import BarSite
from evlcp_sdk.utc import ClockZero


@dataclass(frozen=True)
class Serving:
    """What is served, and where.

    Attributes:
        view: Whether there is a web view.
        host: Where the web view listens: of this machine only, unless it is another address of it.
        port: The same; 0 for any that is free.
        record_to: Where browsers may have recordings written; None: they only look on.
        nmea_port: Port of this machine for NMEA; None for none.
        gpsd_port: The same for gpsd's JSON, whose usual one is 2947.
    """

    view: bool = False
    host: str = "127.0.0.1"
    port: int = 0
    record_to: Path | None = None
    nmea_port: int | None = None
    gpsd_port: int | None = None


class Services:
    """The servers of a live run, in a thread of their own; a context manager around it.

    Args:
        serving: Which.
        publisher: Where results come from.
        links: The configurations by name, as `named_links` gives them.
        name: Name of the source.
        sites: Where the bars stand.
        clock_zero: UTC of the camera clock's 0; None if it is not known.

    Attributes:
        view: The web view; None for none.
        nmea: The server of NMEA; None for none.
        gpsd: That of gpsd's JSON; None for none.

    Raises:
        ConfigError: A port cannot be had, or a package is not installed.
    """

    def __init__(
        self,
        serving: Serving,
        publisher: Publisher,
        links: Mapping[str, Link],
        *,
        name: str,
        sites: Sequence[BarSite] = (),
        clock_zero: ClockZero = None,
    ) -> None:
        self._recorder: Recorder | None = None
        self.view: Viewer | None = None
        if serving.view:
            if serving.record_to is not None:
                camera = next(iter(links.values())).camera
                self._recorder = Recorder(publisher, serving.record_to, camera.width, camera.height)
            self.view = Viewer(
                publisher,
                links,
                name=name,
                sites=sites,
                host=serving.host,
                port=serving.port,
                recorder=self._recorder,
            )
        ports = {False: serving.nmea_port, True: serving.gpsd_port}
        self.nmea, self.gpsd = (
            None if port is None else TcpOutput(publisher, gpsd=gpsd, port=port, clock_zero=clock_zero)
            for gpsd, port in ports.items()
        )
        self._publisher = publisher
        self._stack = ExitStack()

    @property
    def dropped(self) -> dict[str, int]:
        """Results that clients were not sent as they did not take them, by server."""
        servers = {"view": self.view, "nmea": self.nmea, "gpsd": self.gpsd}
        return {name: server.dropped for name, server in servers.items() if server is not None}

    def __enter__(self) -> Self:
        servers = [one for one in (self.view, self.nmea, self.gpsd) if one is not None]
        with ExitStack() as stack:
            if servers:
                loop_thread = stack.enter_context(LoopThread())
                for server in servers:
                    stack.callback(loop_thread.finish, loop_thread.call(server.start()))
            stack.callback(self._publisher.close)
            if self._recorder is not None:
                stack.callback(self._recorder.stop)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the servers, once they have told what there is; a recording is completed."""
        self._stack.__exit__(kind, value, trace)
