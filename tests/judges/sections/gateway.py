"""CANopen drives behind a gateway, whose process data take more than one frame."""

import struct
import time

import cia402
import cycle as cyclic
import rig

ESI = rig.ROOT / "configs/esi/gateway.xml"
NODES = """
[device.can]
bit_rate = 1_000_000
sync     = "4ms"

[[device.node]]
id      = 1
drive   = "EPOS 24/1"
outputs = [{ pdo = 1, at = 2, objects = ["0x6040", "0x607A"] }]
inputs  = [{ pdo = 1, at = 2, objects = ["0x6041", "0x6064"] }]

[[device.node]]
id        = 2
drive     = "EPOS 24/5"
heartbeat = "50ms"
outputs   = [{ pdo = 1, at = 12, objects = ["0x6040", "0x206B"] }]
inputs    = [{ pdo = 1, at = 12, objects = ["0x6041", "0x606C"] }]
"""
TOGGLE = 0x80
# Manual HMSI-168-81 §6.2: command in bits 4 to 6, extension in bits 0 to 3; node 128 means all nodes.
START, NODE_STATE, GENERAL_STATUS, ALL = 0x01, 0x10, 0x20, 128
OPERATIONAL = 1


class Gateway:
    """Control and status word, followed by a node's bytes."""

    def __init__(self, slave, cycle):
        self.slave = slave
        self.cycle = cycle
        self.outputs = bytearray(len(slave.output))

    def send(self):
        self.slave.output = bytes(self.outputs)

    def command(self, command, node):
        """Returns the seven bits of the answer, or None without the matching toggle bit."""
        toggle = ~self.slave.input[0] & TOGGLE
        self.outputs[0:2] = bytes([toggle | command, node])
        self.send()
        answered = self.cycle.until(lambda: self.slave.input[0] & TOGGLE == toggle, 2)
        return self.slave.input[0] & 0x7F if answered else None


def gateway(bench):
    report = bench.report
    report.section("CANopen gateway, several frames a cycle")
    machine = rig.Machine()
    machine.add("nodes", ESI, "GW64", more=NODES)
    # 512 bytes in one device exceed SOEM, which stores 4096 bytes of an EEPROM of 16384.
    for n in range(11):
        machine.add(f"other{n}", ESI, "GW64")
    with bench.serve(machine, "gateway"), bench.master() as master:
        bench.found(master, machine)
        size = master.config_map()
        report.equal("the process image takes two frames", size, 12 * 2 * 64)
        for slave in master.slaves:
            slave.set_watchdog("processdata", 2_000)
        cycle = cyclic.to_op(master, sum(device.wkc for device in machine.devices))
        report.need("Op", cycle is not None, cyclic.states(master))
        # If one of the two frames is late, SOEM counts only the other; a stalling computer causes this.
        for _ in range(5):
            cycle.forget()
            cycle.run(500)
            if not cycle.wrong:
                break
        report.check("500 cycles of two frames, none with a wrong working counter", not cycle.wrong, cycle)
        slave = master.slaves[0]
        nodes(bench, Gateway(slave, cycle))
        # Data from the network is readable at 0x2000: one byte per subindex, 128 per object.
        status = slave.sdo_read(0x2000, 3) + slave.sdo_read(0x2000, 4)
        report.equal("0x2000 reads the process data", status, bytes(slave.input[2:4]))


def nodes(bench, device):
    report = bench.report
    report.equal("all nodes are started", device.command(START, ALL), START, hex)
    for node in (1, 2):
        # A heartbeat reports the state.
        end = time.monotonic() + 10
        while device.command(NODE_STATE, node) != NODE_STATE | OPERATIONAL and time.monotonic() < end:
            pass
        state = device.command(NODE_STATE, node)
        report.equal(f"node {node} is Operational", state, NODE_STATE | OPERATIONAL, hex)
    report.equal("nothing is wrong", device.command(GENERAL_STATUS, 0), GENERAL_STATUS, hex)
    report.equal("and no node is in error", device.slave.input[1], 0)

    def statusword():
        return struct.unpack_from("<H", device.slave.input, 2)[0]

    def position():
        return struct.unpack_from("<i", device.slave.input, 4)[0]

    def control(word, target):
        struct.pack_into("<Hi", device.outputs, 2, word, target)
        device.send()

    def enabled():
        state = cia402.state_of(statusword())
        control(cia402.TOWARDS_ENABLED.get(state, 0), position())
        return state == "Operation enabled"

    report.need("node 1 is enabled", device.cycle.until(enabled, 5), hex(statusword()))
    target = position() + 4_000
    control(0x0F, target)
    device.cycle.run(50)
    # Profile position mode: a new set-point, at once.
    control(0x3F, target)
    arrived = device.cycle.until(lambda: abs(position() - target) <= 2, 10)
    report.check("node 1 reaches its target", arrived, f"{position()}, target {target}")


