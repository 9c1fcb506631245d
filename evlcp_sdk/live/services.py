"""The services of a live run: the web view, NMEA and gpsd's JSON over TCP."""

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
class ServiceOptions:
    """The services and their ports.

    Attributes:
        view: There is a web view.
        host: Address of the web view; others than this machine reach it only at another one.
        port: Its port; 0 for any free one.
        record_to: Folder in which browsers may start recordings; None to forbid it.
        nmea_port: Port of this machine for NMEA; None for none.
        gpsd_port: The same for gpsd's JSON; its usual one is 2947.
    """

    view: bool = False
    host: str = "127.0.0.1"
    port: int = 0
    record_to: Path | None = None
    nmea_port: int | None = None
    gpsd_port: int | None = None


@contextmanager
def serve(
    options: ServiceOptions,
    publisher: Publisher,
    links: Mapping[str, Link],
    *,
    name: str,
    sites: Sequence[BarSite] = (),
    clock_zero: ClockZero = None,
) -> Iterator[dict[str, Server]]:
    """Serve in a thread beside a live run; at the end, close the publisher and complete a recording.

    Gives the servers in use: `view`, `nmea` and `gpsd`. `links` are the configurations by name, as
    `name_links` gives them; `name` is that of the source.

    Raises:
        ConfigError: A port cannot be used, or a package is not installed.
    """
    recorder = None
    servers: dict[str, Server] = {}
    if options.view:
        if options.record_to is not None:
            camera = next(iter(links.values())).camera
            recorder = Recorder(publisher, options.record_to, camera.width, camera.height)
        host, port = options.host, options.port
        servers["view"] = Viewer(
            publisher, links, name=name, sites=sites, host=host, port=port, recorder=recorder
        )
    for kind, tcp_port in (("nmea", options.nmea_port), ("gpsd", options.gpsd_port)):
        if tcp_port is not None:
            servers[kind] = TcpOutput(publisher, gpsd=kind == "gpsd", port=tcp_port, clock_zero=clock_zero)
    with ExitStack() as stack:
        if servers:
            loop_thread = stack.enter_context(LoopThread())
            for server in servers.values():
                stack.callback(loop_thread.finish, loop_thread.call(server.start()))
        stack.callback(publisher.close)
        if recorder is not None:
            stack.callback(recorder.close)
        yield servers
