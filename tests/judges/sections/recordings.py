"""Checks of a recording: tshark dissects it, and every working counter matches its prediction."""

import random
import subprocess

import dissect
import pcapng
import rig
import wkc

# Predictions that are a range, because the recording contains no more information.
RANGES_RATIO = 0.05


def judge(bench, path, clocks, steady=True):
    """Checks a recording of devices, described by their clocks. With `steady`, the devices stay constant."""
    report = bench.report
    if dissect.available():
        frames, ethercat, malformed, remarks = dissect.dissect(path)
        report.equal("tshark dissects every frame as EtherCAT", ethercat, frames)
        report.equal("tshark finds no malformed packet", malformed, 0)
        report.equal("tshark's expert has no remark", dissect.remarks_but_soem(remarks), {})
    elif bench.on_ci:
        report.check("tshark is installed", False, "apt-get install tshark")
    else:
        report.note("skipped: no tshark to dissect the recording")
    if not steady:
        return
    walk = wkc.walk(path, clocks)
    report.note(walk.summary)
    report.equal("working counters as predicted", walk.wrong[:5], [])
    report.equal("every frame is answered", walk.unanswered, 0)
    ranges = walk.ranges.total() / (walk.exact.total() + walk.ranges.total())
    report.check("nearly all predicted exactly", ranges < RANGES_RATIO, f"{ranges:.2%} are a range")


def falsified(bench, path, clocks):
    """Checks that one wrong counter of each command is detected; otherwise the check has no value."""
    places = wkc.walk(path, clocks).places
    found, _ = pcapng.exchanges(path)
    dice = random.Random(1)
    for where in places.values():
        number, n = dice.choice(where)
        found[number - 1].answer[n].wkc += 1
    walk = wkc.Walk(clocks)
    for exchange in found:
        walk.exchange(exchange)
    noticed = {line.split()[2] for line in walk.wrong}
    bench.report.equal("a falsified counter of every command is noticed", noticed, set(places))


def recordings(bench):
    """Records the MainDevice of ecaxis on the simulated bus, in virtual time."""
    report = bench.report
    for name, clocks in (("demo", [True] * 2), ("modes", [True] * 3)):
        report.section(f"recording of `ecaxis run configs/{name}.toml`")
        path = bench.folder / f"{name}.pcapng"
        command = [bench.program, "run", f"configs/{name}.toml", "--virtual", "--for", "3s"]
        done = subprocess.run(
            [*map(str, command), "--force", "--record", str(path)], cwd=rig.ROOT, capture_output=True, text=True
        )
        report.need("the run succeeds", done.returncode == 0, done.stderr[-500:] if done.returncode else "")
        judge(bench, path, clocks)
        falsified(bench, path, clocks)
