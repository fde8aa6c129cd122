"""Operations in addition to the cycle: custom mappings, SDOs in Op, clocks, restart."""

import struct
import threading

import pysoem

import cia402
import cycle as cyclic

RX = [(0x6040, 16), (0x607A, 32), (0x6060, 8)]
TX = [(0x6041, 16), (0x6064, 32), (0x6061, 8), (0x60F4, 32)]
# ETG.1000.4: difference to the reference clock.
DIFFERENCE, DELAY, SYSTEM_TIME = 0x092C, 0x0928, 0x0910
LOCKED_NS = 200


def operation(bench):
    report = bench.report
    report.section("own mappings, SDOs in Op, clocks")
    machine = bench.machine()
    x = machine.devices[0]
    x.rx = [(index, 0, bits, "") for index, bits in RX]
    x.tx = [(index, 0, bits, "") for index, bits in TX]
    x.rx_bits, x.tx_bits = sum(b for _, b in RX), sum(b for _, b in TX)
    with bench.serve(machine, "operation"), bench.master() as master:
        bench.found(master, machine)
        master.slaves[0].config_func = lambda _: remap(master.slaves[0])
        size = master.config_map()
        lengths = (len(master.slaves[0].output), len(master.slaves[0].input))
        report.equal("the own mapping's bytes out and in", lengths, (x.rx_bits // 8, x.tx_bits // 8))
        report.check("the process image has a size", size > 0, size)
        master.config_dc()
        for slave, device in zip(master.slaves, machine.devices):
            if device.rx_bits:
                slave.set_watchdog("processdata", 2_000)
        cycle = cyclic.to_op(master, sum(d.wkc for d in machine.devices))
        report.need("Op", cycle is not None, cyclic.states(master))
        drive = cia402.Drive(master.slaves[0], x)
        report.check("x is enabled with the own mapping", cycle.until(drive.towards_enabled, 5), drive.state)
        sdo_in_op(bench, cycle, master, machine)
        clocks(bench, master, machine)
        again(bench, master, machine)


def remap(slave):
    for assign, pdo, entries in ((0x1C12, 0x1600, RX), (0x1C13, 0x1A00, TX)):
        slave.sdo_write(assign, 0, b"\0")
        slave.sdo_write(pdo, 0, b"\0")
        for sub, (index, bits) in enumerate(entries, 1):
            slave.sdo_write(pdo, sub, struct.pack("<I", index << 16 | bits))
        slave.sdo_write(pdo, 0, bytes([len(entries)]))
        slave.sdo_write(assign, 1, struct.pack("<H", pdo))
        slave.sdo_write(assign, 0, b"\1")


def sdo_in_op(bench, cycle, master, machine):
    """A thread reads large objects while the cycle continues."""
    report = bench.report
    large = master.slaves[machine.index("mailbox")]
    done, errors = [], []

    def read():
        try:
            for _ in range(20):
                done.append(len(large.sdo_read(0x2000, 0, 1000, release_gil=True)))
        except (pysoem.SdoError, pysoem.MailboxError, pysoem.WkcError) as error:
            errors.append(error)

    cycle.forget()
    thread = threading.Thread(target=read)
    thread.start()
    cycle.until(lambda: not thread.is_alive(), 10)
    thread.join()
    report.equal("20 objects of 500 bytes are read in Op", (done, errors), ([500] * 20, []))
    report.check("and no cycle has a wrong working counter", not cycle.wrong, cycle)


def clocks(bench, master, machine):
    """With FRMW in every frame, the simulated clocks follow the reference at their own rate."""
    report = bench.report
    delays = []
    for name, slave, device in zip(machine.names, master.slaves, machine.devices):
        if not device.dc:
            continue
        raw = struct.unpack("<I", slave._fprd(DIFFERENCE, 4, cyclic.TIMEOUT_US))[0]
        report.check(f"{name}: the clock is locked", raw & 0x7FFFFFFF < LOCKED_NS, f"{raw & 0x7FFFFFFF} ns")
        delays.append(struct.unpack("<I", slave._fprd(DELAY, 4, cyclic.TIMEOUT_US))[0])
    report.check("propagation delays grow along the line", delays == sorted(delays), delays)
    report.check("the first is the reference", delays and delays[0] == 0, delays)


def again(bench, master, machine):
    """A killed MainDevice restarts on a bus that is still in Op."""
    report = bench.report
    report.equal("config_init once more, from Op", master.config_init(), len(machine.devices))
    # SOEM acknowledges with every request; controllers without an application show that as an error.
    states = [state.removesuffix("+Error") for state in cyclic.states(master)]
    report.equal("all are in PreOp", set(states), {"PreOp"})
