"""The use cases: what a program does with a recording, and what the commands parse and print."""

from collections.abc import Iterator
from html import escape
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

from evlcp_sdk.errors import InputError
from evlcp_sdk.io import EventSource, Loss, open_source
from evlcp_sdk.io.sensor import check_sensor
from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.results.tables import frames_table
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.values import Frame, Packet

if TYPE_CHECKING:
    import pandas
    import pyarrow

__all__ = ["Reception", "receive"]


def receive(
    source: EventSource | str | Path, link: Link | None = None, *, registry: Registry | None = None
) -> "Reception":
    """Receive a recording or a camera: an iterator over its packets, in constant memory.

    The packets that the stream's end completes come, too, and the source is closed behind the last one.

    Args:
        source: What to open, plugins asked first; or a source that is open, which is read on and closed.
        link: The configuration; None for all defaults.
        registry: Plugins whose hooks are called; None for all that are installed.

    Raises:
        InputError: The source cannot be opened.
        ConfigError: The recording's sensor is not the link's.
    """
    registry = Registry.load() if registry is None else registry
    link = load_link(registry=registry) if link is None else link
    opened = source if isinstance(source, EventSource) else open_source(source, registry)
    try:
        check_sensor(opened, opened.path if isinstance(source, EventSource) else source, link.camera)
        return Reception(opened, Receiver(link, registry.hook), link)
    except BaseException:
        opened.close()
        raise


class Reception(Iterator[Packet]):
    """The packets of a source as they are complete; made by `receive`.

    A context manager for whoever may leave before the end. A source that cannot be read on gives the packets
    decoded until there, and then raises.

    Attributes:
        source: What is read.
        receiver: What decodes it.
        link: The configuration.
    """

    def __init__(self, source: EventSource, receiver: Receiver, link: Link) -> None:
        self.source = source
        self.receiver = receiver
        self.link = link
        self._packets = self._read()

    def _read(self) -> Iterator[Packet]:
        with self.source:
            try:
                for events in self.source.chunks():
                    yield from self.receiver.feed(events)
            except InputError:
                yield from self.receiver.close()
                raise
            yield from self.receiver.close()

    def __next__(self) -> Packet:
        """The next packet.

        Raises:
            InputError: The source cannot be read on.
        """
        return next(self._packets)

    def frames(self) -> Iterator[Frame]:
        """Yield the frames of the packets that follow."""
        for packet in self:
            yield from packet.frames

    def to_pandas(self) -> "pandas.DataFrame":
        """The frames of the packets that follow as a table of pandas, with the columns of `frames.csv`.

        Raises:
            ConfigError: pandas is not installed.
        """
        frame: pandas.DataFrame = frames_table(self, "pandas")
        return frame

    def to_arrow(self) -> "pyarrow.Table":
        """The same as a table of Arrow.

        Raises:
            ConfigError: pyarrow is not installed.
        """
        return frames_table(self, "arrow")

    @property
    def counts(self) -> dict[str, int]:
        """What the receiver has taken, found and dropped so far."""
        return self.receiver.counts

    @property
    def losses(self) -> dict[str, Loss]:
        """What the source had to skip or doubt so far, by kind."""
        return self.source.losses

    def close(self) -> None:
        """Leave, where need be before the end: packets that are not complete are given up."""
        self._packets = iter(())
        self.source.close()

    def __repr__(self) -> str:
        counts = self.counts
        found = ", ".join(f"{counts[name]} {name}" for name in ("events", "packets", "frames"))
        return f"Reception({self.source.path}: {found} so far)"

    def _repr_html_(self) -> str:
        """What a notebook shows: everything counted so far, and what was lost; reads nothing."""
        rows = [(name.replace("_", " "), str(number)) for name, number in self.counts.items() if number]
        rows += [("lost", str(loss)) for loss in self.losses.values()]
        cells = "".join(f"<tr><td>{escape(name)}</td><td>{escape(text)}</td></tr>" for name, text in rows)
        return f"<p>{escape(repr(self))}</p><table><tbody>{cells}</tbody></table>"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
