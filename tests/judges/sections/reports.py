"""Chromium opens the pages of `ecaxis analyze` and `ecaxis bench`: what they show, and that nothing is cut or missing."""

import contextlib
import subprocess

import rig

from .page import open_browser

CONFIGS = rig.ROOT / "configs"
# `y` faults while both axes move.
FAULTS = '[[fault]]\nkind = "drive-fault"\nat = "1500ms"\ndevice = 1\ncode = 0x3220\n'
MEDIA = {"light": {"color_scheme": "light"}, "dark": {"color_scheme": "dark"}, "print": {"media": "print"}}
WIDTHS = {"wide": 1280, "narrow": 420}
# Returns what is wrong with the texts of the plots, in pixels.
TEXTS = """() => {
    const wrong = [];
    for (const figure of document.querySelectorAll("figure")) {
        const title = figure.querySelector("figcaption").textContent;
        const svg = figure.querySelector("svg");
        const edge = svg.getBoundingClientRect();
        const texts = [...svg.querySelectorAll("text")].filter((text) => text.getBBox().width > 0);
        const boxes = texts.map((text) => [text.textContent, text.getBoundingClientRect()]);
        for (const [text, box] of boxes) {
            if (box.left < edge.left - 1 || box.right > edge.right + 1 || box.top < edge.top - 1 || box.bottom > edge.bottom + 1) wrong.push(`${title}: "${text}" is cut`);
        }
        boxes.forEach(([a, one], n) => boxes.slice(n + 1).forEach(([b, other]) => {
            const across = Math.min(one.right, other.right) - Math.max(one.left, other.left);
            const down = Math.min(one.bottom, other.bottom) - Math.max(one.top, other.top);
            if (across > 1 && down > 4) wrong.push(`${title}: "${a}" over "${b}"`);
        }));
    }
    return wrong;
}"""
# Returns the plots without a unit.
UNITS = """() => [...document.querySelectorAll("figure")].filter((figure) => {
    const along = [...figure.querySelectorAll(".scale text[text-anchor=middle]")];
    const up = figure.querySelectorAll(".scale text[text-anchor=end]");
    const unit = figure.querySelector(".unit");
    return !along.length || !along.every((text) => /[0-9] ?(s|ms|µs|us|ns)$/.test(text.textContent)) || (up.length && !unit?.textContent);
}).map((figure) => figure.querySelector("figcaption").textContent)"""


def reports(bench):
    report = bench.report
    report.section("the pages of `ecaxis analyze` and `ecaxis bench` in Chromium")
    with contextlib.ExitStack() as stack:
        browser = open_browser(bench, stack)
        if browser is None:
            return
        for name, page in {"fault": analyzed(bench, "demo.toml", FAULTS), "axes": analyzed(bench, "groups.toml"), "bench": measured(bench)}.items():
            for look, options in MEDIA.items():
                for size, width in WIDTHS.items():
                    shows(report, browser, page, f"{name}, {look}, {size}", options, width)
            works(report, browser, page, name)
    pictures = rig.target() / "reports"
    report.note(f"pictures: {pictures}")


def ecaxis(bench, *arguments, codes=(0,)):
    done = subprocess.run([str(bench.program), *map(str, arguments)], capture_output=True, text=True, timeout=300)
    if done.returncode not in codes:
        raise RuntimeError(f"{arguments}: {done.returncode}\n{done.stderr}")


def analyzed(bench, machine, faults=None):
    """Records a run in virtual time and returns the page about it."""
    folder = bench.folder
    recording, page = folder / f"{machine}.pcapng", folder / f"{machine}.html"
    options = ["--virtual", "--sim", "--repeat", "1", "--record", recording, "--force", "--no-fault-report"]
    if faults:
        script = folder / "faults.toml"
        script.write_text(faults)
        options += ["--faults", script]
    ecaxis(bench, "run", CONFIGS / machine, *options, codes=(0, 1))
    ecaxis(bench, "analyze", recording, "--machine", CONFIGS / machine, "--html", page, "--force")
    return page


def measured(bench):
    page = bench.folder / "bench.html"
    ecaxis(bench, "bench", "--sim", "--axes", "2", "--cycle", "2ms", "--seconds", "2", "--rounds", "1", "--against", "sleep", "--html", page, "--force")
    return page


@contextlib.contextmanager
def opened(browser, path, options, width):
    """Yields the page and what it complains of or asks for."""
    context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=options.get("color_scheme"))
    page = context.new_page()
    complaints = []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda request: complaints.append(request.url) if request.url != path.as_uri() else None)
    if "media" in options:
        page.emulate_media(media=options["media"])
    page.goto(path.as_uri())
    try:
        yield page, complaints
    finally:
        context.close()


def shows(report, browser, path, name, options, width):
    with opened(browser, path, options, width) as (page, complaints):
        report.check(f"{name}: there are plots", page.locator("figure").count() >= 3)
        report.equal(f"{name}: no plot without unit", page.evaluate(UNITS), [])
        report.equal(f"{name}: no label is cut or hidden", page.evaluate(TEXTS), [])
        wide = page.evaluate("document.documentElement.scrollWidth - innerWidth")
        report.check(f"{name}: no wider than the window", wide <= 0 or "media" in options, f"{wide} px")
        colour = page.evaluate("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).slice(0, 3).map(Number)")
        report.check(f"{name}: its background", (max(colour) < 60) == ("dark" in options.values()), colour)
        report.equal(f"{name}: buttons", page.is_visible(".tools"), "media" not in options)
        pictures = rig.target() / "reports"
        pictures.mkdir(parents=True, exist_ok=True)
        page.screenshot(path=pictures / f"{name.replace(', ', '-')}.png", full_page=True)
        report.equal(f"{name}: no console message, no request", complaints, [])


def works(report, browser, path, name):
    """The fault comes first; zoom and the values under the pointer."""
    with opened(browser, path, {}, 1280) as (page, complaints):
        lead = page.inner_text("h1 + .lead")
        report.check(f"{name}: the result comes first", lead, lead)
        titles = page.locator("figcaption").all_text_contents()
        if name == "fault":
            report.check("fault: the cause", "0x3220" in lead and "y:" in lead, lead)
            report.check("fault: a marker in each plot", page.evaluate("[...document.querySelectorAll('figure')].every(figure => figure.querySelector('[data-marker] title'))"))
            report.check("fault: following errors", {"x: following error", "y: following error"} <= set(titles), titles)
            report.equal("fault: no set-point of a velocity in CSP", page.locator("figure", has_text="x: velocity").locator(".legend .entry").count(), 1)
        figure = page.locator("figure").nth(1)
        plot = figure.locator("svg[role=img]")
        ticks = lambda: figure.locator(".scale text").all_text_contents()  # noqa: E731
        values = lambda: " ".join(figure.locator("output").all_text_contents()).strip()  # noqa: E731
        whole = ticks()
        plot.scroll_into_view_if_needed()
        box = plot.bounding_box()
        x, y = (lambda part: box["x"] + part * box["width"]), box["y"] + box["height"] / 2
        report.equal(f"{name}: no value without pointer", values(), "")
        page.mouse.move(x(0.4), y)
        shown = values()
        report.check(f"{name}: the values under the pointer", any(c.isdigit() for c in shown) and " at " in f" {shown}", shown)
        page.mouse.down()
        page.mouse.move(x(0.6), y, steps=3)
        page.mouse.up()
        closer = ticks()
        report.check(f"{name}: dragging zooms", closer != whole, closer)
        report.equal(f"{name}: no label is cut or hidden after it", page.evaluate(TEXTS), [])
        page.mouse.move(x(0.5), y)
        report.check(f"{name}: other values under the pointer", values() not in ("", shown), values())
        plot.press("0")
        report.equal(f"{name}: the key 0 shows the whole", ticks()[0], whole[0])
        page.click(".tools [data-act=closer]")
        report.check(f"{name}: the button zooms", ticks() != whole)
        plot.dblclick()
        report.equal(f"{name}: a double click shows the whole", len(ticks()), len(whole))
        report.equal(f"{name}: no console message, no request meanwhile", complaints, [])
