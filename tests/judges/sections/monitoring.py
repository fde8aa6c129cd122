"""Prometheus' promtool judges the metrics of a running server, the alert rules and the dashboard."""

import json
import pathlib
import re
import shutil
import subprocess
import tempfile
import time
import urllib.request

import rig

FOLDER = rig.ROOT / "configs/monitoring"
FAULT = "[[fault]]\nkind = 'drive-fault'\nat = '4s'\ndevice = 0\ncode = 0x3210\n"


def monitoring(bench):
    report = bench.report
    report.section("monitoring")
    if not shutil.which("promtool"):
        if bench.on_ci:
            raise RuntimeError("promtool is missing")
        raise rig.Skip("promtool is missing (Debian: prometheus)")
    with tempfile.TemporaryDirectory(prefix="ecaxis-judge-") as folder:
        before, after = scrape(bench, pathlib.Path(folder))
    for text in (before, after):
        accepted(report, "check metrics", text, "check", "metrics")
    values = [read(text) for text in (before, after)]
    trips = 'ecaxis_axis_trips_total{axis="x",cause="drive"}'
    report.equal("the simulated fault is counted once", [v[trips] for v in values], [0, 1])
    falling = [name for name, value in values[0].items() if is_counter(name, before) and values[1][name] < value]
    report.equal("no counter falls", falling, [])
    cycles = values[1]["ecaxis_cycles_total"]
    waked = values[1]["ecaxis_wakeup_lateness_seconds_count"]
    report.check("every cycle is in the histogram", waked >= cycles * 0.99, f"{waked:.0f} of {cycles:.0f}")
    rules = (FOLDER / "alerts.yml").read_text()
    accepted(report, "check rules", None, "check", "rules", FOLDER / "alerts.yml")
    accepted(report, "test rules", None, "test", "rules", FOLDER / "alerts.test.yml")
    dashboard = json.loads((FOLDER / "ecaxis.json").read_text())
    expressions = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    report.check("the dashboard has expressions", len(expressions) > 10, len(expressions))
    parsed = [{"record": "judge:x", "expr": e.replace("$__rate_interval", "1m")} for e in expressions]
    with tempfile.NamedTemporaryFile("w", suffix=".yml") as file:
        # JSON is YAML. One group for each, as equal names in a group are refused.
        groups = [{"name": str(n), "rules": [rule]} for n, rule in enumerate(parsed)]
        json.dump({"groups": groups}, file)
        file.flush()
        accepted(report, "every expression of the dashboard parses", None, "check", "rules", "--lint=none", file.name)
    exported = {name.split("{")[0] for name in values[1]}
    for source, text in (("dashboard", json.dumps(dashboard)), ("alerts", rules)):
        # The title and the tag `ecaxis` have no underscore.
        named = set(re.findall(r"\becaxis_\w+", text))
        report.equal(f"{source}: every name is exported", sorted(named - exported), [])
    documented = set(re.findall(r"`(ecaxis_\w+)", (rig.ROOT / "docs/monitoring.md").read_text()))
    types = set(re.findall(r"^# TYPE (\S+)", after, re.M))
    report.equal("docs/monitoring.md lists the exported metrics", sorted(documented ^ types), [])


def scrape(bench, folder):
    """Returns the metrics before and after a drive's fault."""
    faults = folder / "faults.toml"
    faults.write_text(FAULT)
    # A ring has metrics of its own.
    machine = folder / "ring.toml"
    text = (rig.ROOT / "configs/demo.toml").read_text().replace("[bus]", '[bus]\nredundant = "second"', 1)
    machine.write_text(text.replace('"esi/', f'"{rig.ROOT}/configs/esi/'))
    command = [str(bench.program), "serve", str(machine), "--sim", "--http", "127.0.0.1:0"]
    command += ["--socket", str(folder / "s.sock"), "--faults", str(faults)]
    with rig.process(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as child:
        url = child.stdout.readline().split("#")[0] + "metrics"
        get = lambda: urllib.request.urlopen(url, timeout=10).read().decode()  # noqa: E731
        before = await_text(get, 'ecaxis_bus_state{state="op"} 1', "ecaxis_cycles_total ")
        after = await_text(get, 'ecaxis_axis_trips_total{axis="x",cause="drive"} 1', "ecaxis_cycles_total ")
        # The samples are taken over a little later than the counters.
        time.sleep(1)
        return before, get() or after


def await_text(get, *wanted):
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        text = get()
        if all(each in text for each in wanted):
            return text
        time.sleep(0.1)
    raise RuntimeError(f"no {wanted} in:\n{text}")


def read(text):
    lines = [line.rsplit(" ", 1) for line in text.splitlines() if not line.startswith("#")]
    return {name: float(value) for name, value in lines}


def is_counter(name, text):
    """True for counters, and for the parts of histograms, which count too."""
    bare = name.split("{")[0]
    return f"# TYPE {bare} counter" in text or bare.endswith(("_bucket", "_count", "_sum"))


def accepted(report, name, text, *arguments):
    done = subprocess.run(["promtool", *map(str, arguments)], input=text, capture_output=True, text=True)
    output = (done.stdout + done.stderr).strip()
    report.check(f"promtool: {name}", done.returncode == 0 and "warn" not in output.lower(), output if done.returncode else "")
