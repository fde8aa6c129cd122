#!/usr/bin/env python3
"""Makes the picture of the README: the page of `ecaxis serve` while the program of the demonstration moves its axes.

Run in an environment with `requirements.txt` installed: `python tests/judges/picture.py docs/images/page.png`.
"""

import sys
import tempfile
import time

import rig
from sections.page import Server, Tab, chromium, wait_for

SIZE = {"width": 1100, "height": 640}
WINDOW_NS = 5_000_000_000
# Of the program, until the trace fills the plots.
SECONDS = 3.3


def main(target):
    with tempfile.TemporaryDirectory() as folder, chromium() as browser, Server(rig.binary(), folder, "--control") as server:
        tab = Tab(browser, server, viewport=SIZE)
        observer = server.observer
        if not observer.do("take", name="program", ttl_ms=60000)["ok"]:
            sys.exit("another client owns the motion")
        tab.page.click("#tab-scope")
        tab.page.select_option("select[aria-label='Length of the window']", str(WINDOW_NS))
        observer.do("program", action="start")
        wait_for("the axis moves", observer.moves)
        time.sleep(SECONDS)
        tab.page.screenshot(path=target)
        observer.do("release")
        tab.close()


if __name__ == "__main__":
    main(sys.argv[1])
