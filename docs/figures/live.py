"""The picture of the live view: docs/images/live.png.

    python docs/figures/live.py docs/images/live.png REC.raw --sites site.toml --attitude FILE.csv

The recording is replayed four times slower before headless Chromium, which is driven as by the tests.
"""

import argparse
import base64
import sys
import threading
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from evlcp_sdk.link.several import load_links, name_links
from evlcp_sdk.live import Budget, Publisher
from evlcp_sdk.live.server import serve
from evlcp_sdk.live.viewer import Viewer
from evlcp_sdk.place.navigator import PositionPlan
from evlcp_sdk.run import live
from evlcp_sdk.scene.attitude import AttitudeLog
from evlcp_sdk.scene.sites import load_sites

SLOWER = 4
HIGH = 1080


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--sites", type=Path, required=True)
    parser.add_argument("--attitude", type=Path, required=True)
    parser.add_argument("--at-s", type=float, default=0.9, help="of the recording's time")
    given = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).parents[2]))
    from tests.unit.study.browser import Browser

    links, publisher, sites = load_links(None), Publisher(), load_sites(given.sites)
    attitude = AttitudeLog.read(given.attitude)
    view = Viewer(publisher, name_links(links), name=given.recording.name, sites=sites)
    over = threading.Event()
    with (
        TemporaryDirectory() as folder,
        serve(publisher, [view]),
        Browser(Path(folder)) as browser,
    ):
        # Or else it tells of every picture that the page gets.
        browser.say("Network.disable")
        browser.dress(1280, dark=False)
        browser.say(
            "Emulation.setDeviceMetricsOverride", width=1280, height=HIGH, deviceScaleFactor=1, mobile=False
        )
        browser.open(view.url)
        runner = threading.Thread(
            target=live,
            args=(f"replay:{given.recording}?speed={1 / SLOWER}", None, links),
            kwargs={
                "plan": PositionPlan(sites),
                "attitude": attitude,
                "publisher": publisher,
                "budget": Budget(waiting_ms=1000, most_ms=10_000),
                "stopped": over.is_set,
            },
        )
        mine = publisher.subscribe({"status"}, most=10)
        runner.start()
        first_us = None
        while not mine.ended:
            for news in mine.take(1.0):
                if news.value.events and first_us is None:
                    first_us = news.t_us
                if first_us is not None and news.t_us > first_us + given.at_s * 1e6:
                    over.set()
            if over.is_set():
                break
            time.sleep(0.1)
        given.out.write_bytes(base64.b64decode(browser.say("Page.captureScreenshot")["data"]))
        over.set()
        runner.join()


if __name__ == "__main__":
    main()
