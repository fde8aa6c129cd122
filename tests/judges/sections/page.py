"""Chromium opens the page of `ecaxis serve`, commands the simulated demo machine, and disappears in several ways.

An independent client on the control socket sees what the axes do: every cycle's values, the state and the events.
"""

import contextlib
import http.client
import http.server
import json
import math
import os
import re
import shutil
import signal
import socket
import tempfile
import threading
import time
from pathlib import Path
from urllib.parse import urlsplit

import rig

CONFIG = rig.ROOT / "configs/demo.toml"
# The limits of axis `x` in this file, in mm, mm/s and mm/s², and its resolution in mm.
RANGE, ACCELERATION, COUNT = 60.0, 2500.0, 5.0 / 2000
# Of the velocity limit.
JOG_PERCENT, JOG_SPEED = 15, 37.5
CYCLE_S = 1e-3
VIEWS = ["bus", "axes", "scope", "timing", "program", "events"]
SIZES = {"light": (1400, 900), "dark": (1400, 900), "phone": (360, 780), "4k": (3840, 2160)}
# A loaded computer may stall for seconds.
DEADLINE = 30
CARD = ".card[data-axis=x]"
FORWARD = f'{CARD} [data-jog="1"]'
MINE = "body.mine"


def wait_for(what, question, deadline=DEADLINE):
    """Returns the first true answer to a question."""
    end = time.monotonic() + deadline
    while not (answer := question()):
        if time.monotonic() > end:
            raise TimeoutError(what)
        time.sleep(0.02)
    return answer


class Observer:
    """A client on the control socket. It sees everything, and moves an axis only where a check says so."""

    def __init__(self, path):
        self.connection = socket.socket(socket.AF_UNIX)
        self.connection.connect(str(path))
        self.answers, self.events, self.rows, self.missed = {}, [], [], 0
        self.next = 1
        threading.Thread(target=self.read, daemon=True).start()
        self.do("hello", name="observer")
        self.do("subscribe", topics=["events", "samples"], interval_ms=20, signals=["x.target_position", "x.position"])

    def read(self):
        with contextlib.suppress(OSError, ValueError):
            for line in self.connection.makefile():
                message = json.loads(line)
                if message.get("event") == "samples":
                    self.missed += message["missed"]
                    self.rows += [(t, *row) for t, row in zip(message["time_ns"], message["rows"], strict=True)]
                elif "event" in message:
                    self.events.append(message)
                else:
                    self.answers[message["id"]] = message

    def do(self, op, **keys):
        number, self.next = self.next, self.next + 1
        self.connection.sendall((json.dumps({"id": number, "op": op, **keys}) + "\n").encode())
        wait_for(f"answer to {op}", lambda: number in self.answers)
        return self.answers.pop(number)

    def axis(self):
        return next(axis for axis in self.do("state")["axes"] if axis["name"] == "x")

    def owner(self):
        owner = self.do("state")["lease"]["owner"]
        return owner and owner["name"]

    def targets(self, start=0):
        return [row[1] for row in self.rows[start:] if row[1] is not None]

    def travel(self, cycles):
        """Returns the distance between the outermost set-points of the last cycles."""
        last = self.targets()[-cycles:]
        return max(last) - min(last) if len(last) == cycles else math.nan

    def moves(self):
        return self.travel(100) > 2 * COUNT

    def rests(self):
        return self.travel(200) == 0

    def close(self):
        self.connection.close()


class Server:
    """`ecaxis serve` of the demo machine on the simulated bus."""

    def __init__(self, program, folder, *options, port=0, config=CONFIG):
        self.folder, self.path = Path(folder), Path(folder) / "control.sock"
        self.path.unlink(missing_ok=True)
        # A token from a file is not printed.
        file = options[options.index("--token-file") + 1] if "--token-file" in options else None
        self.token = f"#token={Path(file).read_text().strip()}" if file else ""
        self.output = self.folder / "output"
        command = [str(program), "serve", str(config), "--sim", "--socket", str(self.path), "--http", f"127.0.0.1:{port}", *options]
        self.stack = contextlib.ExitStack()
        output = self.stack.enter_context(self.output.open("w"))
        self.child = self.stack.enter_context(rig.process(command, stdout=output, stderr=output))
        self.address = wait_for("the printed address", self.printed)
        self.port = urlsplit(self.address).port
        self.origin = f"http://127.0.0.1:{self.port}"
        self.observer = Observer(self.path)
        answer = self.observer.do("await", bus="op")
        if not answer["ok"]:
            raise RuntimeError(f"{answer}\n{self.output.read_text()}")

    def printed(self):
        if self.child.poll() is not None:
            raise RuntimeError(f"{' '.join(self.child.args)}: {self.output.read_text()}")
        found = re.search(r"http://127\.0\.0\.1:\d+/(#\S+)?\n", self.output.read_text())
        return found and found[0].strip() + self.token

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.observer.close()
        self.child.send_signal(signal.SIGINT)
        with contextlib.suppress(Exception):
            self.child.wait(10)
        self.stack.close()


class Tab:
    """A tab with the page. It notes console messages, failed requests, and requests to other servers."""

    def __init__(self, browser, server, address=None, **options):
        self.complaints = []
        self.server = server
        self.context = browser.new_context(**options)
        self.page = self.context.new_page()
        self.page.set_default_timeout(DEADLINE * 1e3)
        self.page.on("console", lambda message: self.complain("console", message.text, message.type))
        self.page.on("pageerror", lambda error: self.complain("error", error))
        self.page.on("request", lambda request: self.check_request(request.url))
        self.page.on("websocket", lambda link: self.check_request(link.url))
        self.page.goto(address or server.address)
        self.page.wait_for_selector(f"{CARD} [data-value=position]")

    def until(self, condition):
        """Waits for a condition in the page. Its content security policy forbids Playwright's own way."""
        wait_for(condition, lambda: self.page.evaluate(condition))

    def complain(self, *what):
        self.complaints.append(what)

    def check_request(self, url):
        parts = urlsplit(url)
        if parts.scheme not in ("blob", "data") and parts.netloc != urlsplit(self.server.origin).netloc:
            self.complain("request", url)

    def own(self):
        """Takes control and enables the axis."""
        self.page.click("#tab-axes")
        if not self.page.is_visible(MINE):
            self.page.click("#lease")
            self.page.wait_for_selector(MINE)
        self.page.select_option(".jog-speed select", str(JOG_PERCENT))
        if not self.server.observer.axis()["enabled"]:
            self.page.click(f"{CARD} [data-op=enable]")
        self.page.wait_for_selector(f"{FORWARD}:enabled")

    def press(self):
        """Holds the jog button until the axis moves."""
        box = self.page.locator(FORWARD).bounding_box()
        self.page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        self.page.mouse.down()
        wait_for("the axis moves", self.server.observer.moves)
        # At its whole speed, unless a stall of the computer has ended the jog.
        with contextlib.suppress(TimeoutError):
            wait_for("its speed", lambda: self.server.observer.travel(100) > 0.8 * JOG_SPEED * 0.1, 2)
        return self.server.observer.targets()[-1]

    def let_go(self):
        self.page.mouse.up()

    def close(self):
        with contextlib.suppress(Exception):
            self.context.close()


@contextlib.contextmanager
def chromium():
    from playwright.sync_api import sync_playwright

    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if program is None:
        raise FileNotFoundError("chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        try:
            yield browser
        finally:
            browser.close()


def open_browser(bench, stack):
    """Returns None without Chromium; on CI that is an error."""
    try:
        return stack.enter_context(chromium())
    except (ImportError, FileNotFoundError) as error:
        if bench.on_ci:
            raise
        bench.report.note(f"skipped: {error} is missing")
        return None


def page(bench):
    report = bench.report
    report.section("the page of `ecaxis serve` in Chromium")
    with contextlib.ExitStack() as stack:
        browser = open_browser(bench, stack)
        if browser is None:
            return
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="ecaxis-page-")))
        token = folder / "token"
        token.write_text("a-token-of-the-judges-0123456789\n")
        token.chmod(0o600)
        with Server(bench.program, folder, "--control", "--token-file", str(token)) as server:
            shows(bench, browser, server)
            jogs(report, browser, server)
            disappears(report, browser, server)
            others(report, browser, server)
            samples(report, browser, server)
            foreign_origin(report, browser, server)
            port = server.port
            tab = Tab(browser, server)
        restarts(bench, folder, token, tab, port)
        presses(bench, browser, folder)
        reads_only(bench, browser, folder)
        hour(bench, browser, folder)


def shows(bench, browser, server):
    """Every view in every size, light and dark."""
    report = bench.report
    pictures = rig.target() / "page"
    pictures.mkdir(parents=True, exist_ok=True)
    for size, (width, height) in SIZES.items():
        options = {"viewport": {"width": width, "height": height}, "color_scheme": "light" if size == "light" else "dark"}
        if size == "phone":
            options |= {"has_touch": True, "is_mobile": True, "device_scale_factor": 2}
        tab = Tab(browser, server, **options)
        too_wide = []
        for view in VIEWS:
            tab.page.click(f"#tab-{view}")
            tab.page.wait_for_selector(f"#{view}", state="visible")
            if view == "scope":
                tab.until("window.__samples && window.__samples.times.length > 100")
            tab.page.wait_for_timeout(300)
            tab.page.screenshot(path=pictures / f"{view}-{size}.png", full_page=size == "phone")
            if tab.page.evaluate("document.documentElement.scrollWidth > innerWidth"):
                too_wide.append(view)
        if size == "light":
            names = tab.page.locator(".card").evaluate_all("cards => cards.map(card => card.dataset.axis)")
            report.equal("the page shows the axes", names, ["x", "y"])
            report.check("the address keeps no token", "token" not in tab.page.url and "judges" not in tab.page.url, tab.page.url)
        report.equal(f"no view is wider than the window ({size})", too_wide, [])
        report.equal(f"no console message, failed or foreign request ({size})", tab.complaints, [])
        tab.close()
    report.note(f"pictures: {pictures}")


def decelerates(report, what, observer, start, at_cut):
    """Waits for rest after the tab commands no more, and checks how it came."""
    with contextlib.suppress(TimeoutError):
        wait_for("rest", observer.rests)
    # All rows from before the cut on. A jog that stopped in one cycle would show one and a half times the limit.
    # A stalled computer skips cycles; there is no second difference across them.
    rows, span = [row for row in observer.rows[start:] if row[1] is not None], 10
    targets, step = [row[1] for row in rows], span * CYCLE_S
    triples = zip(rows, rows[span:], rows[2 * span :])
    bends = [abs(a[1] - 2 * b[1] + c[1]) / step**2 for a, b, c in triples if (c[0] - a[0]) * 1e-9 < (2 * span + 0.7) * CYCLE_S]
    # A cycle after a late one begins sooner than a cycle later, with a whole step.
    speeds = [abs(b[1] - a[1]) / max(CYCLE_S, (b[0] - a[0]) * 1e-9) for a, b in zip(rows, rows[1:])]
    room = 4 * COUNT / step**2
    report.check(f"{what}: the axis comes to rest", observer.rests(), f"{targets[-1] - at_cut:.2f} mm after")
    report.check(f"{what}: not faster than the jog", max(speeds) < JOG_SPEED * 1.05 + room * CYCLE_S, f"{max(speeds):.1f} mm/s")
    # Without a stop it would go on to the end of its range.
    report.check(f"{what}: before half of the rest of its range", targets[-1] < (at_cut + RANGE) / 2, f"{targets[-1]:.2f} mm")
    report.check(f"{what}: within its acceleration limit", max(bends) < ACCELERATION * 1.01 + room, f"{max(bends):.0f} mm/s²")


def rewind(server, to=-20.0):
    """Moves the axis back, by the observer."""
    observer = server.observer
    wait_for("a free lease", lambda: observer.owner() is None)
    assert observer.do("take", name="observer", ttl_ms=60000)["ok"]
    if not observer.axis()["enabled"]:
        observer.do("enable", axis="x", wait=True)
    observer.do("move", axis="x", to=to, speed=0.5, wait=True)
    observer.do("release")


def jogs(report, browser, server):
    """Control, enable, hold, let go, by pointer and by key."""
    observer = server.observer
    tab = Tab(browser, server)
    report.check("without control, commands are disabled", tab.page.is_disabled(FORWARD))
    tab.own()
    report.equal("the page has the lease", observer.owner(), "page")
    rewind_by_page(tab)
    start, events = len(observer.rows), len(observer.events)
    at_cut = tab.press()
    tab.let_go()
    decelerates(report, "button let go", observer, start, at_cut)
    report.check("button let go: the page ended the jog, not its silence", not [event for event in observer.events[events:] if event["event"] == "let_go"])

    start, events = len(observer.rows), len(observer.events)
    before = observer.targets()[-1]
    tab.page.focus(FORWARD)
    tab.page.keyboard.down(" ")
    tab.page.wait_for_timeout(600)
    report.equal("one key event moves nothing", observer.targets()[-1], before)
    deadline = time.monotonic() + DEADLINE
    while not observer.moves() and time.monotonic() < deadline:
        tab.page.keyboard.down(" ")
        tab.page.wait_for_timeout(30)
    report.check("a repeated key moves the axis", observer.moves())
    at_cut = observer.targets()[-1]
    tab.page.keyboard.up(" ")
    decelerates(report, "key let go", observer, start, at_cut)
    report.check("key let go: the page ended the jog, not its silence", not [event for event in observer.events[events:] if event["event"] == "let_go"])

    start, events = len(observer.rows), len(observer.events)
    at_cut = tab.press()
    tab.page.mouse.move(5, 5)
    decelerates(report, "pointer left the button", observer, start, at_cut)
    report.check("pointer left the button: the page ended the jog, not its silence", not [event for event in observer.events[events:] if event["event"] == "let_go"])
    tab.let_go()
    report.equal("no console message while jogging", tab.complaints, [])
    tab.close()
    wait_for("the lease ends with the tab", lambda: observer.owner() is None)


def rewind_by_page(tab):
    tab.page.fill(f"{CARD} .move input", "-55")
    tab.page.click(f"{CARD} [data-op=move]")
    wait_for("the move", lambda: abs(tab.server.observer.targets()[-1] + 55) < COUNT and tab.server.observer.rests())


def disappears(report, browser, server):
    """The tab closes, loses its network, or stands still: the axis stops."""
    observer = server.observer

    def closes(tab):
        tab.page.close()
        # The page may still say goodbye.
        return "disconnected", "released"

    def crashes(_):
        for process in renderers(browser):
            os.kill(process, signal.SIGKILL)
        return ("disconnected",)

    def loses_network(tab):
        link = tab.context.new_cdp_session(tab.page)
        link.send("Network.enable")
        link.send("Network.emulateNetworkConditions", {"offline": True, "latency": 0, "downloadThroughput": -1, "uploadThroughput": -1})
        return ("expired",)

    def freezes(_):
        stopped = renderers(browser)
        for process in stopped:
            os.kill(process, signal.SIGSTOP)
        return ("expired",)

    def is_busy(tab):
        # The script of the page stands still for longer than the lease.
        tab.page.evaluate("setTimeout(() => { const begin = performance.now(); while (performance.now() - begin < 2500); }, 0)")
        return ("expired",)

    for what, act in [("tab closed", closes), ("tab crashed", crashes), ("network lost", loses_network), ("tab frozen", freezes), ("tab busy", is_busy)]:
        rewind(server, -55.0)
        tab = Tab(browser, server)
        tab.own()
        start, events = len(observer.rows), len(observer.events)
        at_cut = tab.press()
        try:
            why = act(tab)
            decelerates(report, what, observer, start, at_cut)
            ends = wait_for("the event", lambda: [event for event in observer.events[events:] if event["event"] == "lease" and event["why"] in why])
            report.check(f"{what}: the event names the page", "page" in json.dumps(ends[0]["previous"]), ends[0]["why"])
        finally:
            for process in renderers(browser):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(process, signal.SIGCONT)
        if what in ("tab frozen", "tab busy"):
            tab.page.wait_for_timeout(1500)
            report.check(f"{what}: nothing moves when it is back, with the button still held", observer.rests())
            tab.let_go()
        tab.close()


def renderers(browser):
    link = browser.new_browser_cdp_session()
    found = link.send("SystemInfo.getProcessInfo")["processInfo"]
    link.detach()
    return [process["id"] for process in found if process["type"] == "renderer"]


def others(report, browser, server):
    """Stop without the lease; taking over."""
    observer = server.observer
    tab = Tab(browser, server)
    rewind(server)

    def moves_slowly():
        observer.do("take", name="cell", ttl_ms=60000)
        observer.do("enable", axis="x", wait=True)
        observer.do("move", axis="x", to=55.0 if observer.axis()["position"] < 0 else -55.0, speed=0.05)
        wait_for("the axis moves", observer.moves)

    for what, act in [("Stop without control", lambda: tab.page.click("#stop")), ("Escape without control", lambda: tab.page.keyboard.press("Escape"))]:
        moves_slowly()
        tab.until("document.getElementById('owner').textContent.includes('cell')")
        act()
        wait_for("rest", observer.rests)
        report.check(f"{what}: the axis stops", abs(observer.targets()[-1]) < 54, f"{observer.targets()[-1]:.2f} mm")
        report.equal(f"{what}: the owner stays", observer.owner(), "cell")

    moves_slowly()
    tab.page.click("#lease")
    tab.page.click("#take-over button[value=cancel]")
    tab.page.wait_for_timeout(300)
    report.equal("Cancel leaves the owner", observer.owner(), "cell")
    tab.page.click("#lease")
    tab.page.click("#take-over button[value=take]")
    tab.page.wait_for_selector(MINE)
    wait_for("rest", observer.rests)
    report.equal("taking over: the page owns", observer.owner(), "page")
    report.check("taking over: the move stops first", abs(observer.targets()[-1]) < 54)
    refused = observer.do("move", axis="x", to=0.0, speed=0.1)
    report.check("taking over: the other client is refused, with the owner's name", not refused["ok"] and "page" in json.dumps(refused), refused.get("error"))
    tab.page.click("#lease")
    wait_for("release", lambda: observer.owner() is None)
    report.equal("no console message while others own", tab.complaints, [])
    tab.close()


def samples(report, browser, server):
    """The scope has exactly the values of the cycles."""
    observer = server.observer
    rewind(server)
    tab = Tab(browser, server)
    tab.page.click("#tab-scope")
    tab.until("window.__samples && window.__samples.times.length > 500")
    observer.do("take", name="observer", ttl_ms=60000)
    observer.do("move", axis="x", to=20.0, speed=0.3, wait=True)
    tab.page.click("#scope .tools button.primary")
    shown = tab.page.evaluate(
        """() => {
            const { times, signals, oneCycle, live, missed } = window.__samples;
            const pick = (name) => Array.from(signals.find((signal) => signal.name === name).values);
            return { times: Array.from(times, String), target: pick("x.target_position"), position: pick("x.position"), oneCycle, live, missed };
        }"""
    )
    known = {row[0]: row[1:] for row in observer.rows}
    rows = list(zip(map(int, shown["times"]), shown["target"], shown["position"], strict=True))
    both = [row for row in rows if row[0] in known]
    wrong = [row for row in both if row[1:] != tuple(known[row[0]])]
    report.check("the paused scope shows every cycle", shown["oneCycle"] and not shown["live"] and shown["missed"] == 0, f"{len(rows)} rows")
    report.check("its times are times of cycles", len(both) >= len(rows) - 1 and len(both) > 500, f"{len(both)} of {len(rows)}")
    report.equal("its values are equal to the last bit", wrong[:3], [])
    report.check("among them is a motion", max(row[1] for row in rows) - min(row[1] for row in rows) > 1)
    # The same cycles in one picture of an hour, as least and greatest values.
    tab.page.select_option('[aria-label="Length of the window"]', "3600000000000")
    tab.until("!window.__samples.oneCycle")
    wide = tab.page.evaluate("(() => { const s = window.__samples.signals.find(s => s.name === 'x.target_position'); return [s.least, s.greatest].map(a => Array.from(a).filter(v => !Number.isNaN(v))); })()")
    targets = observer.targets()
    report.check("an hour in one picture loses no extreme value", min(wide[0]) <= min(targets) and max(wide[1]) >= max(targets), f"{min(wide[0])} … {max(wide[1])}")
    with tab.page.expect_download() as download:
        tab.page.select_option('[aria-label="Length of the window"]', "1000000000")
        tab.page.click('#scope button:text("CSV")')
    lines = Path(download.value.path()).read_text().splitlines()
    report.check("CSV has every cycle", len(lines) > 500, f"{len(lines)} lines: {lines[0]}")
    observer.do("release")
    report.equal("no console message in the scope", tab.complaints, [])
    tab.close()


def hour(bench, browser, folder):
    """A set-point that lasts one cycle of an hour is in the widest picture."""
    report = bench.report
    with Server(bench.program, folder, "--virtual") as server:
        observer = server.observer
        observer.do("unsubscribe", topics=["samples"])
        observer.do("take", name="observer", ttl_ms=60000)
        observer.do("enable", axis="*", wait=True)
        half = lambda: [observer.do("advance", seconds=225) for _ in range(8)]  # noqa: E731
        half()
        spike = COUNT / 2
        observer.do("stream_open", axis="x", interval_ms=1, interpolation="linear", prefill=3)
        answer = observer.do("stream_push", axis="x", points=[[0.0], [spike], [0.0], [0.0]])
        report.check("the set-points are accepted", answer.get("accepted") == 4, answer)
        half()
        tab = Tab(browser, server, viewport={"width": 1280, "height": 800})
        tab.page.click("#tab-scope")
        tab.page.select_option('[aria-label="Length of the window"]', "3600000000000")
        found = "window.__samples?.signals.find(s => s.name === 'x.target_position')"

        def is_shown():
            # The live view follows new samples.
            observer.do("advance", seconds=0.1)
            return tab.page.evaluate(f"{found} !== undefined && !window.__samples.oneCycle")

        wait_for("the view of an hour", is_shown)
        greatest = tab.page.evaluate(f"Array.from({found}.greatest).filter(v => !Number.isNaN(v))")
        shown = [value for value in greatest if value > 0]
        report.equal("one column of an hour has the spike", shown, [spike])
        report.check("the picture is of the whole hour", len(greatest) > 500, f"{len(greatest)} columns")
        tab.page.screenshot(path=rig.target() / "page" / "scope-hour.png")
        tab.close()


def foreign_origin(report, browser, server):
    """A page from another origin can neither read nor command, not even if it knows the address and the token."""
    observer = server.observer

    class Foreign(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(b"<!doctype html><title>foreign</title>")

        def log_message(self, *_):
            pass

    foreign = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Foreign)
    threading.Thread(target=foreign.serve_forever, daemon=True).start()
    rewind(server)
    observer.do("take", name="observer", ttl_ms=60000)
    observer.do("move", axis="x", to=50.0, speed=0.02)
    wait_for("the axis moves", observer.moves)
    context = browser.new_context()
    page = context.new_page()
    page.goto(f"http://127.0.0.1:{foreign.server_address[1]}/")
    token = server.address.split("#")[1].removeprefix("token=")
    attempts = page.evaluate(
        """async ([origin, token]) => {
            const attempt = async (work) => { try { return await work(); } catch { return "refused"; } };
            const socket = (first) => new Promise((resolve) => {
                const link = new WebSocket(origin.replace("http", "ws") + "/api/ws");
                link.onopen = () => link.send(JSON.stringify(first));
                link.onmessage = (event) => resolve(event.data);
                link.onerror = link.onclose = () => resolve("refused");
            });
            const bearer = { Authorization: `Bearer ${token}` };
            return {
                read: await attempt(async () => (await fetch(origin + "/api/state")).text()),
                readWithToken: await attempt(async () => (await fetch(origin + "/api/state", { headers: bearer })).text()),
                stop: await attempt(async () => (await fetch(origin + "/api/stop", { method: "POST", headers: bearer, body: "{}" })).text()),
                blindStop: await attempt(async () => (await fetch(origin + "/api/stop", { method: "POST", mode: "no-cors", body: "{}" })).type),
                form: await attempt(async () => { navigator.sendBeacon(origin + "/api/stop", "{}"); return "sent"; }),
                socket: await socket({ id: 1, op: "token", token }),
            };
        }""",
        [server.origin, token],
    )
    for name in ("read", "readWithToken", "stop", "socket"):
        report.equal(f"another origin: {name}", attempts[name], "refused")
    page.wait_for_timeout(500)
    report.check("another origin: the axis goes on", observer.moves() and observer.axis()["moving"], attempts)
    report.equal("another origin: the owner stays", observer.owner(), "observer")
    context.close()
    foreign.shutdown()

    for name, headers in {"Host": {"Host": "attacker.example"}, "Origin": {"Origin": "http://attacker.example"}}.items():
        link = http.client.HTTPConnection("127.0.0.1", server.port, timeout=DEADLINE)
        link.request("GET", "/api/state", headers=headers)
        report.equal(f"a foreign {name} is forbidden", link.getresponse().status, 403)
        link.close()
    observer.do("stop")
    observer.do("release")


def restarts(bench, folder, token, tab, port):
    """The server ends and comes back: the page says so, and reads again."""
    report = bench.report
    tab.page.wait_for_selector("body.stale")
    report.check("without the server, the page says that its values are old", "No connection" in tab.page.inner_text("#notice"), tab.page.inner_text("#notice"))
    with Server(bench.program, folder, "--control", "--token-file", str(token), port=port):
        tab.page.wait_for_selector("body:not(.stale)")
        tab.until("document.getElementById('bus-state').textContent === 'bus in Op'")
        report.check("the page connects again by itself", True)
        errors = [complaint for complaint in tab.complaints if complaint[0] != "console"]
        report.equal("no error and no foreign request meanwhile", errors, [])
    tab.close()


def presses(bench, browser, folder):
    """Inputs of the simulated bus, by the names that the machine file gives them."""
    report = bench.report
    with Server(bench.program, folder, "--control", config=rig.ROOT / "configs/pick-and-place.toml") as server:
        observer = server.observer

        def level():
            return next(line["value"] for line in observer.do("state")["inputs"] if line["name"] == "Input 5")

        tab = Tab(browser, server)
        tab.page.click("#tab-bus")
        switch = '[data-switch="start"]'
        tab.page.wait_for_selector(switch)
        names = tab.page.locator("[data-switch]").evaluate_all("all => all.map(each => each.dataset.switch)")
        report.equal("the page has a switch for each named input", names, ["closed", "hold", "start", "stop"])
        # Inputs need no lease.
        for text, value in (("Press", 1), ("Release", 0)):
            wait_for(f"the button {text}", lambda: tab.page.inner_text(switch) == text)
            tab.page.click(switch)
            wait_for(f"the input is {value}", lambda: level() == value)
            report.equal(f"{text} switches the input", level(), value)
        report.equal("no console message, failed or foreign request (inputs)", tab.complaints, [])
        tab.close()


def reads_only(bench, browser, folder):
    """Without `--control`, the page shows no command."""
    report = bench.report
    with Server(bench.program, folder) as server:
        tab = Tab(browser, server)
        visible = []
        for view in VIEWS:
            tab.page.click(f"#tab-{view}")
            visible += tab.page.locator("#stop, #lease, .commands, [data-op], [data-jog]").evaluate_all("nodes => nodes.filter(node => node.offsetParent).map(node => node.textContent)")
        report.equal("read only: no command is visible", visible, [])
        refused = tab.page.evaluate("(async () => (await fetch('api/stop', { method: 'POST', body: '{}', headers: { Authorization: `Bearer ${sessionStorage.getItem('ecaxis.token')}` } })).status)()")
        report.equal("read only: a command with the token is forbidden", refused, 403)
        tab.close()
