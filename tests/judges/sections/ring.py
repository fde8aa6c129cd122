"""Cable redundancy: a ring that opens and closes again in SOEM's redundant mode."""

import cycle as cyclic
import rig

from .bringup import expected_wkc, mirror

BREAK = '[[fault]]\nat = "500ms"\nfor = "1500ms"\ndevice = 1\nport = 0\nkind = "link-break"\n'


def ring(bench):
    report = bench.report
    report.section("ring")
    machine = bench.machine()
    with rig.veth_pair("cd") as (bus, nic):
        options = ["--nic2", bus]
        with bench.serve(machine, "ring", BREAK, options, steady=False) as served, bench.master(nic, patient=False) as master:
            bench.found(master, machine)
            master.config_map()
            for slave, device in zip(master.slaves, machine.devices):
                if device.rx_bits:
                    slave.set_watchdog("processdata", 2_000)
            cycle = cyclic.to_op(master, expected_wkc(machine))
            report.need("Op", cycle is not None, cyclic.states(master))
            cycle.forget()
            served.strike()
            # Covers the break and its repair.
            cycle.run(3_000)
            lost = cycle.missed + sum(cycle.wrong.values())
            report.check("all cycles but a few have the full working counter", lost < 100, cycle)
            # Lost link counters: port 1 of x, port 0 of y.
            links = master.slaves[0]._fprd(0x0310, 4, cyclic.TIMEOUT_US), master.slaves[1]._fprd(0x0310, 4, cyclic.TIMEOUT_US)
            report.equal("both ends have counted the break", (links[0][1], links[1][0]), (1, 1))
            report.equal("every device stays in Op", set(cyclic.states(master)), {"Op"})
            mirror(bench, cycle, master, machine)
