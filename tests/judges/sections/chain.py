"""Two processes in a line, each with one device: the second one is killed and started again."""

import cycle as cyclic
import rig

from .faults import back, prepared


def chain(bench):
    report = bench.report
    report.section("a line of two processes")
    drives = rig.fixture("esi/maxon/maxon_motor_EPOS4_0170h_6950h_0000h_0000h_ESI.xml")
    both = rig.drive(rig.drive(rig.Machine(), "x", drives, "EPOS4"), "y", drives, "EPOS4")
    first = rig.drive(rig.Machine(), "x", drives, "EPOS4")
    second = rig.drive(rig.Machine(), "y", drives, "EPOS4")
    with rig.veth_pair("cd") as (near, far), rig.served(bench.program, first, bench.bus, options=["--nic2", near]):
        with rig.served(bench.program, second, far) as bus, bench.master(patient=False) as master:
            cycle = prepared(bench, master, both, 2_000)
            rig.ip("link", "set", far, "down")
            bus.child.kill()
            bus.child.wait()
            cycle.forget()
            half = both.devices[0].wkc
            lost = cycle.until(lambda: cycle.wrong.get(half, 0) > 200, 10)
            report.check("the first device goes on alone", lost, cycle)
            report.equal("SOEM sees the second one lost", cyclic.states(master), ["Op", "0x0"])
            with rig.served(bench.program, second, far):
                rig.ip("link", "set", far, "up")
                back(bench, cycle, master)
                report.equal("the first device has not left Op", master.slaves[0].al_status, 0)
