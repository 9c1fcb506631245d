"""What the web view costs the receiver, and how soon it shows something.

    python benchmarks/live_view.py [RECORDING] [--for-s 2] [--rounds 24] [--apart]

The recording is received as fast as it goes, again and again until so much camera time is over, in turn
with nobody looking on and with one who takes all that there is (a process of its own, which draws nothing).
What counts is the ratio of two runs that follow one another, the middle one of all rounds, with the bounds
that it keeps in nine of ten draws of as many rounds from these. Then the command is started and timed until
the first picture is there, and replays the recording at its own pace, again and again without a pause, for
pictures a second. Without a name, two bars of `../shared`.
"""

import argparse
import json
import re
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Self

import numpy as np
from numpy.typing import NDArray
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from evlcp_sdk.io import LoopSource, open_source, open_writer
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.live import Budget, Outlet
from evlcp_sdk.live.services import Services, Serving
from evlcp_sdk.run import live

SHARED = Path(__file__).parents[2] / "shared" / "recordings" / "two-bars-60m-75m.raw"
PATIENT = Budget(waiting_ms=1e6, most_ms=1e7)
LOOK = "import sys; sys.path.insert(0, sys.argv[1]); from live_view import look_at_each; look_at_each()"


def look_at_each() -> None:
    """Look at the views whose addresses come in, one after the other; a line when connected, and of each."""
    for url in sys.stdin:
        print(json.dumps(look(url.strip(), say=True)), flush=True)


def look(url: str, most_s: float = 1e9, *, say: bool = False) -> dict[str, float]:
    """Take all that a view gives, until it ends; pictures, results and when the first picture came."""
    seen: dict[str, float] = {"pictures": 0, "results": 0, "dropped": 0, "first_s": 0.0, "last_s": 0.0}
    began = time.monotonic()
    with connect(url.replace("http", "ws") + "live", compression=None, max_size=None) as link:
        try:
            link.recv()
            if say:
                print("connected", flush=True)
            while time.monotonic() - began < most_s:
                link.send('{"next": true}')
                bundle = link.recv()
                assert isinstance(bundle, bytes)
                (size,) = struct.unpack_from("<I", bundle)
                head = json.loads(bundle[4 : 4 + size])
                seen["pictures"] += head["picture"] is not None
                seen["results"] += len(head["news"])
                seen["dropped"] = head["dropped"]
                if head["picture"] is not None:
                    seen["last_s"] = time.monotonic()
                    seen["first_s"] = seen["first_s"] or seen["last_s"]
        except ConnectionClosed:
            pass
    seen["s"] = time.monotonic() - began
    return seen


class Looker:
    """A process that looks on where it is told to; a context manager."""

    def __enter__(self) -> Self:
        command = [sys.executable, "-c", LOOK, str(Path(__file__).parent)]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
        )
        return self

    def begin(self, url: str) -> None:
        """Look on, from now."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{url}\n")
        self._line()

    def end(self) -> dict[str, float]:
        """What was seen, once there is nothing more to see."""
        seen: dict[str, float] = json.loads(self._line())
        return seen

    def _line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline()

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        self._process.wait(20)


def received(
    recording: Path, for_s: float, *, looker: Looker | None, apart: bool
) -> tuple[dict[str, float], dict[str, float]]:
    """Times to receive, and what was seen of it."""
    outlet, link = Outlet(), load_link()
    with Services(
        Serving(view=looker is not None, apart=apart), outlet, {"": link}, name=recording.name
    ) as services:
        if looker is not None and services.view is not None:
            looker.begin(services.view.url)
        # Without what it took to start.
        served_s = -thread_s("evlcp-desk") - thread_s("evlcp-view")
        summary = live(
            f"replay:{recording}?speed=1000&loop=1&for_s={for_s}",
            None,
            link,
            outlet=outlet,
            pictures=services.pictures,
            budget=PATIENT,
        )
        served_s += thread_s("evlcp-desk") + thread_s("evlcp-view")
    return summary["processing"] | {"served_s": served_s}, {} if looker is None else looker.end()


def thread_s(name: str) -> float:
    """Processor time of a thread of this process, s; 0 where there is none."""
    ids = [thread.native_id for thread in threading.enumerate() if thread.name == name]
    return sum(int(Path(f"/proc/self/task/{one}/schedstat").read_text().split()[0]) for one in ids) * 1e-9


def middle_of(values: NDArray[np.float64]) -> tuple[float, float, float]:
    """The median, between the bounds that hold nine of ten medians of as many values drawn from these."""
    drawn = np.random.default_rng(1).choice(values, (4000, len(values)))
    low, high = np.quantile(np.median(drawn, axis=1), (0.05, 0.95))
    return float(low), float(np.median(values)), float(high)


def without_pause(recording: Path, for_s: float, out: Path) -> None:
    """Write a recording again and again, a millisecond between two passes."""
    passes = LoopSource(lambda: open_source(recording), seam_us=1000, for_us=for_s * 1e6)
    with passes as source, open_writer(out, source.width, source.height) as writer:
        for events, triggers in source.stream():
            writer.write(events, triggers)


def started(recording: Path, for_s: float) -> tuple[float, dict[str, float]]:
    """Time from the command to the first picture, s, and what was seen of a paced replay."""
    code = "from evlcp_sdk.cli.main import main; main()"
    began = time.monotonic()
    command = [sys.executable, "-c", code, "live", f"replay:{recording}", "--view", "--json"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    assert process.stderr is not None
    url = ""
    while not url:
        found = re.search(r"http://\S+", process.stderr.readline())
        url = found[0] if found else ""
    seen = look(url, for_s)
    process.terminate()
    process.wait(20)
    return seen["first_s"] - began, seen


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", nargs="?", type=Path, default=SHARED)
    parser.add_argument("--for-s", type=float, default=2.0)
    parser.add_argument("--rounds", type=int, default=24)
    parser.add_argument("--apart", action="store_true", help="the view in a process of its own")
    given = parser.parse_args()
    alone, viewed, served_ms = [], [], []
    with Looker() as looker:
        # The first round loads what is needed, and does not count.
        for number in range(-1, given.rounds):
            # Each is as often the first one.
            for who in (None, looker) if number % 2 else (looker, None):
                times, seen = received(given.recording, given.for_s, looker=who, apart=given.apart)
                if number < 0:
                    continue
                (alone if who is None else viewed).append(times)
                if who is not None:
                    served_ms.append(times["served_s"] / seen["pictures"] * 1e3)
                    rate = seen["pictures"] / times["elapsed_s"]
    print(f"{given.rounds} rounds of {viewed[-1]['elapsed_s']:.2f} s, {rate:.1f} pictures/s")
    for name, text in (("elapsed_s", "elapsed"), ("processor_s", "processor time of this process")):
        a, b = (np.array([one[name] for one in times]) for times in (alone, viewed))
        low, middle, high = middle_of(b / a - 1)
        best = b.min() / a.min() - 1
        print(f"{text}: {middle:+.1%} ({low:+.1%} to {high:+.1%}), the best of each {best:+.1%}")
    # Pictures come by the clock: where others keep the machine busy there are more of them a second of work.
    cost_ms = float(np.median(served_ms))
    print(
        f"the thread of the view: {cost_ms:.2f} ms a picture, {cost_ms * 2.5:.1f} % of a core at 25 a second"
    )
    with TemporaryDirectory() as folder:
        long = Path(folder) / "long.raw"
        without_pause(given.recording, 4.0, long)
        first_s, seen = started(long, 6.0)
    rate = (seen["pictures"] - 1) / (seen["last_s"] - seen["first_s"])
    print(
        f"first picture {first_s:.2f} s after the command; paced: {rate:.1f} pictures/s,"
        f" {seen['dropped']:g} results dropped"
    )


if __name__ == "__main__":
    main()
