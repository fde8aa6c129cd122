"""Faults, and the return to Op with `recover` and `reconfig`."""

import json
import time

import pysoem

import cycle as cyclic

from .bringup import expected_wkc


def faults(bench):
    watchdog(bench)
    noise(bench)
    outage(bench, "a link breaks and heals", 'device = 2\nport = 0\nkind = "link-break"\n')
    outage(bench, "a device loses its power", 'device = 1\nkind = "absent"\n')
    outage(bench, "the cable at the MainDevice", 'kind = "silent"\n')


def prepared(bench, master, machine, watchdog_ms):
    bench.found(master, machine)
    master.config_map()
    for slave, device in zip(master.slaves, machine.devices):
        if device.rx_bits:
            slave.set_watchdog("processdata", watchdog_ms)
    cycle = cyclic.to_op(master, expected_wkc(machine))
    bench.report.need("Op", cycle is not None, cyclic.states(master))
    return cycle


def watchdog(bench):
    report = bench.report
    report.section("process-data watchdog")
    machine = bench.machine()
    with bench.serve(machine, "watchdog"), bench.master() as master:
        cycle = prepared(bench, master, machine, 300)
        report.equal("the watchdog reads back", master.slaves[0].get_watchdog("processdata"), 300.0)
        time.sleep(1)
        for name, device, state in zip(machine.names, machine.devices, cyclic.states(master)):
            # Without an application, the controller clears the outputs and reports no error.
            watched = device.rx_bits > 0 and device.mailbox
            report.equal(f"{name} after a second's silence", state, "SafeOp+Error" if watched else "Op")
        codes = {s.al_status for s, d in zip(master.slaves, machine.devices) if d.rx_bits and d.mailbox}
        report.equal("AL status code of those", codes, {0x001B})
        back(bench, cycle, master)


def noise(bench):
    """Lost, late, duplicated or damaged frames: cycles are missed, but no reply is wrong."""
    report = bench.report
    report.section("a noisy line")
    machine = bench.machine()
    kinds = ("frame-loss", "frame-duplicate", "frame-corrupt", "frame-delay")
    faults = [f'[[fault]]\nkind = "{kind}"\nprobability = 0.01\n' for kind in kinds]
    script = "".join(faults) + 'delay = "3ms"\n'
    with bench.serve(machine, "noise", script, ["--json"], steady=False) as bus, bench.master(patient=False) as master:
        cycle = prepared(bench, master, machine, 2_000)
        bus.strike()
        cycle.until(lambda: False, 0.5)
        cycle.forget()
        for _ in range(3):
            missed = -cycle.missed
            cycle.run(3_000)
            missed += cycle.missed
            if missed < 270:
                break
        report.check("no working counter is wrong", not cycle.wrong, cycle)
        # Lost, damaged and late frames; twice as many are permitted because of the computer.
        report.check("about 3 % of the cycles are missed", 30 < missed < 270, missed)
        # The state request may be lost as well, and a device that has left Op stays out of Op.
        asked = (set(cyclic.states(master)) for _ in range(5))
        report.check("every device stays in Op", any(states == {"Op"} for states in asked))
        broken = [slave._fprd(0x0300, 8, 100_000) for slave in master.slaves]
        counted = sum(sum(counters[0::2]) for counters in broken)
        report.check("invalid frames are counted", counted > 0, counted)
    statistics = json.loads(bus.output)
    for fault in statistics["faults"]:
        report.check(f"{fault['kind']} struck", fault["frames"] > 0, fault["frames"])
    for count in ("lost", "duplicated", "delayed"):
        report.check(f"frames {count} are counted", statistics[count] > 0, statistics[count])


def outage(bench, what, fault):
    report = bench.report
    report.section(what)
    machine = bench.machine()
    script = f'[[fault]]\nfor = "1500ms"\n{fault}'
    with bench.serve(machine, "outage", script, steady=False) as bus, bench.master(patient=False) as master:
        cycle = prepared(bench, master, machine, 300)
        bus.strike()
        broken = cycle.until(lambda: sum(cycle.wrong.values()) + cycle.missed > 100, 10)
        report.need("the bus breaks", broken, cycle)
        back(bench, cycle, master)


def back(bench, cycle, master):
    """SOEM's usual sequence: acknowledge, request Op, reconfigure, recover, until all devices are in Op."""
    report = bench.report
    used = {}

    def count(step):
        used[step] = used.get(step, 0) + 1

    end = time.monotonic() + 20
    while time.monotonic() < end:
        cycle.run(20)
        master.read_state()
        for slave in master.slaves:
            if slave.state == pysoem.SAFEOP_STATE + pysoem.STATE_ERROR:
                count("acknowledge")
                slave.state = pysoem.SAFEOP_STATE + pysoem.STATE_ACK
                slave.write_state()
            elif slave.state == pysoem.SAFEOP_STATE:
                count("ask for Op")
                slave.state = pysoem.OP_STATE
                slave.write_state()
            elif slave.state > pysoem.NONE_STATE and slave.state != pysoem.OP_STATE:
                count("reconfig")
                if slave.reconfig(500):
                    slave.is_lost = False
            elif slave.state == pysoem.NONE_STATE or slave.is_lost:
                slave.is_lost = True
                count("recover")
                if slave.recover(500):
                    slave.is_lost = False
        if set(cyclic.states(master)) == {"Op"}:
            break
    report.equal("all are back in Op", cyclic.states(master), ["Op"] * len(master.slaves))
    report.note(f"{used}")
    for slave in master.slaves:
        if len(slave.output):
            slave.set_watchdog("processdata", 2_000)
    cycle.forget()
    report.check("with the full working counter", cycle.until(lambda: cycle.good > 190, 10), cycle)
    report.check("and no wrong one", not cycle.wrong, cycle)
