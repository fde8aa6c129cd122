"""What a recording proves: tshark dissects it, and every working counter is as predicted."""

import random
import subprocess

import dissect
import pcapng
import rig
import wkc

# Predictions that are a range, because nothing in the recording tells more.
RANGES_RATIO = 0.05


def judge(bench, path, clocks, steady=True):
    """A recording of these devices, given by their clocks; with `steady`, none of them comes or goes."""
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
    """One wrong counter of each command is noticed; otherwise the walk would prove nothing."""
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
    """Our own MainDevice on the simulated bus, under virtual time."""
    report = bench.report
    for name, clocks in (("demo", [True] * 2), ("modes", [True] * 3)):
        report.section(f"recording of `ecaxis run configs/{name}.toml`")
        path = bench.folder / f"{name}.pcapng"
        command = [bench.program, "run", f"configs/{name}.toml", "--virtual", "--for", "3s"]
        done = subprocess.run(
            [*map(str, command), "--record", str(path)], cwd=rig.ROOT, capture_output=True, text=True
        )
        report.need("the run succeeds", done.returncode == 0, done.stderr[-500:] if done.returncode else "")
        judge(bench, path, clocks)
        falsified(bench, path, clocks)
