"""Headless Chromium without a driver: the DevTools protocol over a pair of pipes."""

import json
import os
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any, Self

CHROMIUM = shutil.which("chromium")

_FLAGS = (
    "--headless --disable-gpu --disable-quic --no-first-run --disable-background-networking --disable-sync"
    " --disable-component-update '--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1'"
    " --window-size=1200,900 --remote-debugging-pipe"
)


class Browser:
    """One page of a fresh browser; use as a context manager."""

    def __init__(self, profile: Path) -> None:
        assert CHROMIUM is not None
        theirs_in, self._out = os.pipe()
        self._in, theirs_out = os.pipe()
        flags = f"{_FLAGS} '--user-data-dir={profile}'{' --no-sandbox' * (os.geteuid() == 0)}"
        self._process = subprocess.Popen(
            ["bash", "-c", f"exec {CHROMIUM} {flags} about:blank 3<&{theirs_in} 4>&{theirs_out}"],
            pass_fds=(theirs_in, theirs_out),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"HOME": str(profile)},
        )
        os.close(theirs_in)
        os.close(theirs_out)
        self._buffer = b""
        self._number = self._width = 0
        self._session: str | None = None
        self.heard: list[dict[str, Any]] = []
        # One of its own may not be there yet.
        target = self.say("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.say("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Network", "Runtime", "Log"):
            self.say(f"{domain}.enable")

    def say(self, method: str, **params: Any) -> dict[str, Any]:
        """Send a command, wait for its answer; what is heard meanwhile is kept."""
        self._number += 1
        command = {"id": self._number, "method": method, "params": params}
        if self._session is not None:
            command["sessionId"] = self._session
        os.write(self._out, json.dumps(command).encode() + b"\0")
        while True:
            message = self._read()
            if message.get("id") == self._number:
                assert "error" not in message, message
                return message["result"]
            self.heard.append(message)

    def _read(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            piece = os.read(self._in, 1 << 20)
            assert piece, "the browser is gone"
            self._buffer += piece
        text, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(text)

    def open(self, place: Path | str) -> None:
        """Load a file, or what a server of this machine gives, and wait until it is there."""
        self.heard.clear()
        self.say("Page.navigate", url=place if isinstance(place, str) else place.as_uri())
        self.until("document.readyState === 'complete'")

    def dress(self, width: int, *, dark: bool) -> None:
        """Show the page as wide as that, in light or in the dark; narrow as a phone does."""
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500}
        self.say("Emulation.setDeviceMetricsOverride", **size)
        features = {"prefers-color-scheme": "dark" if dark else "light", "prefers-reduced-motion": "reduce"}
        pairs = [{"name": name, "value": value} for name, value in features.items()]
        self.say("Emulation.setEmulatedMedia", features=pairs)
        self.until(f"matchMedia('(prefers-color-scheme: dark)').matches === {str(dark).lower()}")
        # A blank page does not say that it is fit for a phone.
        self.until(f"location.href === 'about:blank' || matchMedia('(width: {width}px)').matches")
        self._width = width

    def value(self, expression: str) -> Any:
        """What a JavaScript expression gives."""
        answer = self.say("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def until(self, expression: str) -> Any:
        """What it gives once that is true: however slow the machine is, it waits."""
        end = time.monotonic() + 60
        while not (found := self.value(expression)):
            assert time.monotonic() < end, expression
            time.sleep(0.02)
        return found

    def fits(self) -> bool:
        """Whether the page is no wider than its window."""
        return bool(self.value("document.documentElement.scrollWidth") <= self._width)

    def hover(self, chart: str, label: list[Any]) -> str:
        """What a chart tells when the pointer rests on one of its labels, of the page's `plots`."""
        # The lowest ones stand on the axis.
        x, y = label[0] / 1000, min(label[1] / 1000, 0.98)
        return str(
            self.value(
                f"(() => {{ const area = document.querySelector('#{chart} .area');"
                " area.scrollIntoView({block: 'center', behavior: 'instant'});"
                " const box = area.getBoundingClientRect(), tip = area.querySelector('.tip');"
                f" const at = [box.left + {x} * box.width, box.top + {y} * box.height];"
                " const move = {clientX: at[0], clientY: at[1], bubbles: true};"
                " document.elementFromPoint(...at).dispatchEvent(new PointerEvent('pointermove', move));"
                " return tip.hidden ? '' : tip.textContent })()"
            )
        )

    @property
    def requests(self) -> list[str]:
        """The addresses that the page has asked for."""
        sent = [m["params"]["request"] for m in self.heard if m.get("method") == "Network.requestWillBeSent"]
        return [one["url"] for one in sent]

    @property
    def faults(self) -> list[dict[str, Any]]:
        """Exceptions of the page's scripts, and what the browser or they complain of."""
        wrong = ("Runtime.exceptionThrown", "Log.entryAdded", "Runtime.consoleAPICalled")
        return [m for m in self.heard if m.get("method") in wrong]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *fault: object) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._in)
        os.close(self._out)
