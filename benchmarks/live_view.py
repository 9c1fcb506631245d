"""What the web view costs the receiver, and how soon it shows something.

    python benchmarks/live_view.py [RECORDING] [--for-s 4] [--rounds 6] [--apart]

The recording is received as fast as it goes, again and again until so much camera time is over, in turn
with nobody looking on and with one who takes all that there is (a process of its own, which draws nothing).
What counts is the ratio of two runs that follow one another, the middle one of all rounds. Then the command
is started and timed until the first picture is there, and replays the recording at its own pace, again and
again without a pause, for pictures a second. Without a name, two bars of `../shared`.
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

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from evlcp_sdk.io import LoopSource, open_source, open_writer
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.live import Budget, Outlet
from evlcp_sdk.live.services import Services, Serving
from evlcp_sdk.run import live

SHARED = Path(__file__).parents[2] / "shared" / "recordings" / "two-bars-60m-75m.raw"
PATIENT = Budget(waiting_ms=1e6, most_ms=1e7)
LOOK = "import sys; sys.path.insert(0, sys.argv[2]); from live_view import look; look(sys.argv[1])"


def look(url: str, most_s: float = 1e9) -> dict[str, float]:
    """Take all that a view gives, until it ends; pictures, results and when the first picture came."""
    seen: dict[str, float] = {"pictures": 0, "results": 0, "dropped": 0, "first_s": 0.0, "last_s": 0.0}
    began = time.monotonic()
    with connect(url.replace("http", "ws") + "live", compression=None, max_size=None) as link:
        try:
            link.recv()
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
    print(json.dumps(seen), flush=True)
    return seen


def received(
    recording: Path, for_s: float, *, viewed: bool, apart: bool
) -> tuple[dict[str, float], dict[str, float]]:
    """Times to receive, and what was seen of it."""
    outlet, link = Outlet(), load_link()
    seen: dict[str, float] = {}
    with Services(Serving(view=viewed, apart=apart), outlet, {"": link}, name=recording.name) as services:
        looker = None
        if services.view is not None:
            command = [sys.executable, "-c", LOOK, services.view.url, str(Path(__file__).parent)]
            looker = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
            time.sleep(1.5)
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
    if looker is not None:
        seen = json.loads(looker.communicate(timeout=20)[0])
    return summary["processing"] | {"served_s": served_s}, seen


def thread_s(name: str) -> float:
    """Processor time of a thread of this process, s; 0 where there is none."""
    ids = [thread.native_id for thread in threading.enumerate() if thread.name == name]
    return sum(int(Path(f"/proc/self/task/{one}/schedstat").read_text().split()[0]) for one in ids) * 1e-9


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
    parser.add_argument("--for-s", type=float, default=4.0)
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--apart", action="store_true", help="the view in a process of its own")
    given = parser.parse_args()
    alone, viewed, served_ms = [], [], []
    for number in range(given.rounds):
        # Each is as often the first one.
        for looked_at in (False, True) if number % 2 else (True, False):
            told = received(given.recording, given.for_s, viewed=looked_at, apart=given.apart)
            if looked_at:
                times, seen = told
                viewed.append(times)
            else:
                alone.append(told[0])
        rate = seen["pictures"] / times["elapsed_s"]
        served_ms.append(times["served_s"] / seen["pictures"] * 1e3)
        print(
            f"alone {alone[-1]['elapsed_s']:.2f} s, viewed {times['elapsed_s']:.2f} s, {rate:.1f} pictures/s"
        )
    for name, text in (("elapsed_s", "elapsed"), ("processor_s", "processor time of this process")):
        a, b = (np.array([one[name] for one in times]) for times in (alone, viewed))
        low, middle, high = np.quantile(b / a - 1, (0.25, 0.5, 0.75))
        print(
            f"{text}: {middle:+.1%} ({low:+.1%} to {high:+.1%} of half of the rounds),"
            f" the best of each {b.min() / a.min() - 1:+.1%}"
        )
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
