"""What a live run serves beside its results: the web view, NMEA and gpsd's JSON over TCP."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from evlcp_sdk.link.resolve import Link
from evlcp_sdk.live.publisher import Publisher
from evlcp_sdk.live.recorder import Recorder
from evlcp_sdk.live.server import LoopThread, Server
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


@contextmanager
def serve(
    serving: Serving,
    publisher: Publisher,
    links: Mapping[str, Link],
    *,
    name: str,
    sites: Sequence[BarSite] = (),
    clock_zero: ClockZero = None,
) -> Iterator[dict[str, Server]]:
    """Serve in a thread beside a live run; in the end what there is is told, and a recording completed.

    Gives the servers that were asked for: `view`, `nmea` and `gpsd`.

    Args:
        serving: What.
        publisher: Where results come from; closed in the end.
        links: The configurations by name, as `name_links` gives them.
        name: Name of the source.
        sites: Where the bars stand.
        clock_zero: UTC of the camera clock's 0; None if it is not known.

    Raises:
        ConfigError: A port cannot be had, or a package is not installed.
    """
    recorder = None
    servers: dict[str, Server] = {}
    if serving.view:
        if serving.record_to is not None:
            camera = next(iter(links.values())).camera
            recorder = Recorder(publisher, serving.record_to, camera.width, camera.height)
        host, port = serving.host, serving.port
        servers["view"] = Viewer(
            publisher, links, name=name, sites=sites, host=host, port=port, recorder=recorder
        )
    for kind, chosen in (("nmea", serving.nmea_port), ("gpsd", serving.gpsd_port)):
        if chosen is not None:
            servers[kind] = TcpOutput(publisher, gpsd=kind == "gpsd", port=chosen, clock_zero=clock_zero)
    with ExitStack() as stack:
        if servers:
            loop_thread = stack.enter_context(LoopThread())
            for server in servers.values():
                stack.callback(loop_thread.finish, loop_thread.call(server.start()))
        stack.callback(publisher.close)
        if recorder is not None:
            stack.callback(recorder.close)
        yield servers
