"""Open cameras by the driver `neuromorphic-drivers`: the EVK4, others with its chip's bus, the EVK3 HD."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, Final

from evlcp_sdk.errors import ConfigError, InputError, UnpluggedError, import_extra
from evlcp_sdk.formatting import suggest
from evlcp_sdk.io.evt import EVT3
from evlcp_sdk.io.raw import ChunkReader, RawSource, format_header
from evlcp_sdk.io.urls import parse_flag, parse_positive, split_options
from evlcp_sdk.plugin.source import Loss

_MODULES: Final = {"PROPHESEE_EVK4": "prophesee_evk4", "PROPHESEE_EVK3_HD": "prophesee_evk3_hd"}
"""Devices that send EVT3, and the driver's module for each."""

_WAIT_S: Final = 0.05
"""How long a read waits for the driver before it checks whether it was closed."""

_PERIOD_US: Final = 200
"""The event-rate limit counts events in periods of this length."""

_MAX_PER_PERIOD: Final = (1 << 22) - 1

_RING_PACKETS: Final = 1024
"""USB packets of 128 KB in the driver's ring: a second of the most that a camera sends."""

_SETTLE_S: Final = 1.0
"""How long to keep an unplugged camera before it is closed: the driver aborts if it frees transfers that
libusb's thread is still giving up. That takes milliseconds, unless other work has the processor."""

_HEALTH_PERIOD_S: Final = 5.0

_MAX_FAULTS: Final = 8

_UNPLUGGED: Final = ("NoDevice", "No such device", "Rusb(Io", "Input/output", "Pipe")
_HINTS: Final = (
    (
        ("no device found", "device not found", "NotFound", "Entity not found"),
        "no camera was found: plug it into a USB 3 port by its own cable, see that it is lit, and that lsusb"
        " lists it (04b4:00f4, 04b4:00f5 or 31f7:0003)",
    ),
    (("with serial",), "no camera of that serial was found: ndls lists those that are there"),
    (
        ("Access", "ermission", "insufficient"),
        "this user may not open it: sudo neuromorphic-drivers-install-udev-rules, then plug it in anew",
    ),
    (("Busy", "already used"), "another program uses it: end that one"),
    (
        ("Mismatch", "mismatch", "ShortResponse", "short response", "Timeout", "timed out"),
        "it does not answer as it should: unplug it for some seconds, and use a port that gives enough power",
    ),
    (("Other error",), "this machine has no USB bus that can be read, as in a container without one"),
)


def open_camera(url: str) -> "CameraSource":
    """Open `camera:`, or `camera:SERIAL`, with the options that `docs/live.md` has.

    Raises:
        ConfigError: The extra is not installed, or an option is not known or out of its bounds.
        InputError: There is no such camera, or it cannot be opened.
    """
    driver = import_extra("neuromorphic_drivers", "camera", url)
    biases = [field.name for kind in _MODULES.values() for field in fields(getattr(driver, kind).Biases)]
    name, options = split_options(url, _OPTIONS | dict.fromkeys(biases, _parse_integer))
    serial = name.partition(":")[2].removeprefix("//") or None
    with _explain_faults(url):
        devices = [one for one in driver.list_devices() if serial in (None, one.serial)]
    known = [one for one in devices if one.name.name in _MODULES]
    for one in devices:
        if one.error is not None and not any(other.error is None for other in known):
            raise _make_error(url, str(one.error))
    if not known:
        others = ", ".join(one.name.value for one in devices)
        if others:
            raise InputError(f"{url}: found {others}, expected an EVK4, or another camera with EVT3 words")
        raise _make_error(url, "with serial" if serial else "no device found")
    kind = getattr(driver, _MODULES[known[0].name.name])
    configuration = _make_configuration(url, kind, options)
    with _explain_faults(url):
        device = driver.open(
            configuration,
            raw=True,
            iterator_timeout=_WAIT_S,
            serial=serial or known[0].serial,
            ring_configuration=kind.RingConfiguration(ring_length=_RING_PACKETS),
        )
    try:
        _set_biases(url, kind, device, configuration, options)
        properties = device.properties()
        return CameraSource(url, device, int(properties.width), int(properties.height))
    except BaseException:
        device.close()
        raise


class CameraSource(RawSource):
    """A camera, opened by `open_camera`; its words are decoded as those of a file.

    USB packets that the driver drops are the loss `camera_overflow`. A read after it is unplugged raises an
    `UnpluggedError`.
    """

    live = True

    def __init__(self, url: str, device: Any, width: int, height: int) -> None:
        self._bytes = _CameraReader(url, device, format_header(EVT3, width, height))
        super().__init__(url, file=self._bytes)
        self.format = str(device.name().value)

    @property
    def losses(self) -> dict[str, Loss]:
        """As `EventSource.losses`, with the driver's."""
        dropped = self._bytes.dropped
        return super().losses | ({"camera_overflow": dropped} if dropped.count else {})

    @property
    def health(self) -> Mapping[str, float | int | str]:
        """As `EventSource.health`: `temperature_c`, `backlog` (waiting USB packets), `dropped`, `overflows`.

        At an overflow the driver's ring is full (its clutch engaged), and packets are dropped until it is
        read.
        """
        return dict(self._bytes.health)


class _CameraReader(ChunkReader):
    """The bytes that the camera sends, behind a header.

    Attributes:
        dropped: USB packets that the driver dropped so far.
        health: The health of the source.
    """

    def __init__(self, url: str, device: Any, header: bytes) -> None:
        super().__init__(header)
        self._url = url
        self._device = device
        self._lock = threading.Lock()
        self._closed = False
        self._health_s = -_HEALTH_PERIOD_S
        what = "USB packets that the driver had no room for; the program was too slow"
        self.dropped = Loss(0, 0, "byte", what)
        self._overflows = 0
        self._engaged = False
        self._faults: list[Exception] = []
        self.health: dict[str, float | int | str] = {}

    def read_chunk(self) -> bytes:
        """Wait for bytes; return none once the camera is closed.

        Raises:
            UnpluggedError: The camera is gone.
        """
        data: bytes | None = None
        while not data:
            with self._lock:
                if self._closed:
                    return b""
                try:
                    status, data = next(self._device)
                except (RuntimeError, StopIteration) as fault:
                    # The driver fails before it gives what it still holds, and may fail twice.
                    self._faults.append(fault)
                    if len(self._faults) <= _MAX_FAULTS:
                        continue
                    status = data = None
                if data is None and self._faults:
                    raise _make_error(self._url, str(self._faults[0]), gone=True) from self._faults[0]
                self._update_health(status)
        return data

    def _update_health(self, status: Any) -> None:
        """Update health and losses by the driver's status, and now and then by the camera's temperature."""
        now_s = time.monotonic()
        if now_s >= self._health_s + _HEALTH_PERIOD_S:
            self._health_s = now_s
            # The camera may have no thermometer, and a measurement may fail.
            with contextlib.suppress(RuntimeError, AttributeError):
                self.health["temperature_c"] = round(float(self._device.temperature_celsius()), 1)
        if status.ring is None:
            return
        total = int(status.ring.dropped_packets)
        if total > self.dropped.count:
            self.dropped = self.dropped.add(total - self.dropped.count, self.bytes_read)
        engaged = bool(status.ring.clutch_engaged)
        self._overflows += engaged and not self._engaged
        self._engaged = engaged
        self.health |= {
            "backlog": int(status.ring.backlog),
            "dropped": self.dropped.count,
            "overflows": self._overflows,
        }

    def close(self) -> None:
        """Close the camera; a read in another thread ends soon."""
        is_gone = bool(self._faults) and not self._closed
        self._closed = True
        if is_gone:
            time.sleep(_SETTLE_S)
        with self._lock, contextlib.suppress(RuntimeError):
            self._device.close()


def _parse_integer(text: str) -> int:
    try:
        return int(text)
    except ValueError as fault:
        raise ValueError("a whole number") from fault


def _parse_rate(text: str) -> float:
    rate = parse_positive(text)
    if not 1 <= rate * _PERIOD_US * 1e-6 <= _MAX_PER_PERIOD:
        raise ValueError(f"{1e6 / _PERIOD_US:g} to {_MAX_PER_PERIOD * 1e6 / _PERIOD_US:.3g} events a second")
    return rate


def _parse_areas(text: str) -> list[tuple[int, int, int, int]]:
    areas = []
    for one in text.split(";"):
        sides = [int(side) for side in one.split(",") if side.isascii() and side.isdigit()]
        if len(sides) != 4 or one.count(",") != 3 or not (sides[2] and sides[3]):
            raise ValueError("X,Y,WIDTH,HEIGHT in pixels")
        areas.append((sides[0], sides[1], sides[2], sides[3]))
    return areas


_OPTIONS: Final[dict[str, Callable[[str], Any]]] = {
    "events_per_s": _parse_rate,
    "area": _parse_areas,
    "trigger": parse_flag,
}
"""The parsers of all options but biases."""


def _make_configuration(url: str, kind: Any, options: Mapping[str, Any]) -> Any:
    known = [*_OPTIONS, *(field.name for field in fields(kind.Biases))]
    for name in options:
        if name not in known:
            raise InputError(f"{url}: option {name!r}{suggest(name, known)}")
    settings: dict[str, Any] = {}
    if "trigger" in options:
        settings["enable_external_trigger"] = options["trigger"]
    if "events_per_s" in options:
        per_period = round(options["events_per_s"] * _PERIOD_US * 1e-6)
        settings["rate_limiter"] = kind.RateLimiter(_PERIOD_US, per_period)
    if "area" in options:
        settings |= _make_masks(url, kind, options["area"])
    return kind.Configuration(**settings)


def _make_masks(url: str, kind: Any, areas: Sequence[tuple[int, int, int, int]]) -> dict[str, Any]:
    """Return masks of the columns and rows that lie in no area."""
    width, height = int(kind.Properties().width), int(kind.Properties().height)
    mask = kind.RowColumnMask(set=True)
    for x, y, wide, high in areas:
        if x + wide > width or y + high > height:
            raise InputError(f"{url}: area {x},{y},{wide},{high}: expected within {width} x {height} pixels")
        mask.clear_x_range(x, x + wide, 1)
        # The driver counts rows from below.
        mask.clear_y_range(height - y - high, height - y, 1)
    return {"x_mask": mask.x_mask(), "y_mask": mask.y_mask()}


def _set_biases(url: str, kind: Any, device: Any, configuration: Any, options: Mapping[str, Any]) -> None:
    """Set biases that are within the camera's bounds, which the driver does not check."""
    biases = {name: value for name, value in options.items() if name not in _OPTIONS}
    if not biases:
        return
    with _explain_faults(url):
        bounds = device.biases_bounds()
    for name, value in biases.items():
        limits = getattr(bounds, name)
        if not int(limits.minimum) <= value <= int(limits.maximum):
            raise ConfigError(
                f"{url}: {name} = {value}: expected {int(limits.minimum)} to {int(limits.maximum)}"
            )
    with _explain_faults(url):
        device.update_configuration(replace(configuration, biases=kind.Biases(**biases)))


@contextlib.contextmanager
def _explain_faults(url: str) -> Iterator[None]:
    """Turn the driver's RuntimeErrors into one line with the next step."""
    try:
        yield
    except RuntimeError as fault:
        raise _make_error(url, str(fault)) from fault


def _make_error(url: str, text: str, gone: bool = False) -> InputError:
    if gone or any(word in text for word in _UNPLUGGED):
        return UnpluggedError(
            f"{url}: the camera is gone ({text}): see its cable and port; --reconnect goes on when it is back"
        )
    for words, step in _HINTS:
        if any(word in text for word in words):
            return InputError(f"{url}: {step}")
    return InputError(f"{url}: the driver says: {text}")
