#!/usr/bin/env python3
"""The `canopen` package judges the CAN traffic of simulated drives behind a gateway, by an EDS.

`ecaxis run --sim --virtual --can-log` writes every frame. Each is replayed on a virtual bus of python-can, to which a
node of the package is connected for each drive, with the dictionary of `esi/epos.eds`. The package answers the SDO
requests of the gateway itself: its answers must be those of the simulated drive. Its NMT state machine follows the
gateway's commands, and each heartbeat must show its state. The PDOs are decoded by the mapping that the SDOs have
written. Run in an environment with `requirements.txt` installed: `python tests/judges/canopen_log.py`.
"""

import pathlib
import subprocess
import sys
import tempfile
from collections import Counter

import can
import canopen
import rig
from report import Report

EDS = rig.HERE / "esi/epos.eds"
MACHINE = rig.ROOT / "configs/mixed.toml"
# As in the machine file: node-ID, counts of a turn, length of a turn, limit of the velocity in units a second.
NODES = {1: (2000, 5.0, 50.0), 2: (2000, 5.0, 50.0), 3: (2000, 36.0, 360.0)}
SYNC_S = 0.004
STATES = {0: "INITIALISING", 4: "STOPPED", 5: "OPERATIONAL", 127: "PRE-OPERATIONAL"}
# The serial number and the product differ from drive to drive.
OWN_IDENTITY = ((0x1018, 2), (0x1018, 4))


class Replay:
    """A virtual bus with one node of the package for each drive."""

    def __init__(self, report):
        self.report = report
        self.network = canopen.Network()
        self.network.bus = can.Bus("judge", interface="virtual")
        self.peer = can.Bus("judge", interface="virtual")
        self.nodes = {node: self.network.add_node(canopen.LocalNode(node, str(EDS))) for node in NODES}
        for node in self.nodes.values():
            # A local node of the package starts in INITIALISING.
            node.nmt.state = "PRE-OPERATIONAL"
        self.forget()
        self.answers = {}
        self.counts = Counter()
        self.wrong = Counter()
        self.targets = {node: [] for node in NODES}
        self.positions = {node: [] for node in NODES}
        self.pending = {}
        self.booted = set()
        self.read = set()

    def forget(self):
        while self.peer.recv(0) is not None:
            pass

    def frame(self, message):
        service, node = message.arbitration_id & 0x780, message.arbitration_id & 0x7F
        if node in NODES and service == 0x600:
            self.request(node, message)
        elif node in NODES and service == 0x580:
            self.compare("SDO answers", self.answers.pop(node, None), bytes(message.data), node)
        elif message.arbitration_id == 0:
            self.network.notify(0, message.data, message.timestamp)
            self.forget()
            self.counts["NMT commands"] += 1
            if message.data[0] in (0x81, 0x82):
                self.booted -= set(NODES) if message.data[1] == 0 else {message.data[1]}
        elif node in NODES and service == 0x700:
            self.heartbeat(node, message.data)
        elif message.arbitration_id == 0x80:
            self.counts["SYNC"] += 1
            for node, data in self.pending.items():
                self.targets[node].append(data)
        elif node in NODES and service in (0x180, 0x200):
            self.pdo(node, service, message.data)

    def compare(self, what, expected, found, node):
        self.counts[what] += 1
        if expected != found:
            self.wrong[what] += 1
            self.report.note(f"{what} of node {node}: {found.hex()}, by the package {expected.hex() if expected else None}")

    def request(self, node, message):
        index, sub = int.from_bytes(message.data[1:3], "little"), message.data[3]
        self.forget()
        self.network.notify(message.arbitration_id, message.data, message.timestamp)
        answer = self.peer.recv(5)
        # A write to 0x1017 also sends the first heartbeat of the package.
        while answer and answer.arbitration_id != 0x580 + node:
            answer = self.peer.recv(5)
        self.answers[node] = bytes(answer.data) if answer else None
        if message.data[0] == 0x40 and (index, sub) in OWN_IDENTITY:
            del self.answers[node]

    def heartbeat(self, node, data):
        if data[0] == 0:
            self.booted.add(node)
            self.nodes[node].nmt.state = "PRE-OPERATIONAL"
            self.forget()
            self.counts["boot-ups"] += 1
        elif node in self.booted:
            state = self.nodes[node].nmt.state.encode()
            self.compare("heartbeats", state, STATES.get(data[0], "?").encode(), node)

    def pdo(self, node, service, data):
        local = self.nodes[node]
        maps, name = (local.tpdo, "TPDO") if service == 0x180 else (local.rpdo, "RPDO")
        if local.nmt.state != "OPERATIONAL":
            # The gateway may send to a node that does not listen yet; a node sends none.
            if name == "TPDO":
                self.compare("PDOs outside OPERATIONAL", b"none", bytes(data), node)
            return
        maps = maps[1]
        if (node, name) not in self.read:
            maps.read(from_od=False)
            self.read.add((node, name))
        expected = sum(variable.length for variable in maps) // 8
        self.compare(f"{name} lengths", bytes([expected]), bytes([len(data)]), node)
        maps.data = bytearray(data)
        values = {variable.index: variable.raw for variable in maps}
        if name == "TPDO":
            self.positions[node].append((values[0x6041], values[0x6064]))
        else:
            self.pending[node] = (values[0x6040], values[0x2062])


def main():
    report = Report()
    report.section("CAN traffic of simulated drives, judged by canopen")
    with tempfile.TemporaryDirectory(prefix="ecaxis-judge-") as folder:
        log = pathlib.Path(folder) / "can.log"
        arguments = [rig.binary(), "run", MACHINE, "--sim", "--virtual", "--can-log", log]
        subprocess.run(arguments, check=True, capture_output=True)
        replay = Replay(report)
        for message in can.CanutilsLogReader(str(log)):
            replay.frame(message)
    for what in ("SDO answers", "heartbeats", "RPDO lengths", "TPDO lengths", "boot-ups", "SYNC"):
        report.check(f"{replay.counts[what]} {what}", replay.counts[what] >= 3 and not replay.wrong[what], replay.wrong[what])
    report.equal("no PDO outside OPERATIONAL", replay.counts["PDOs outside OPERATIONAL"], 0)
    for node, (counts, turn, velocity) in NODES.items():
        targets, positions = replay.targets[node], replay.positions[node]
        powered = [target for word, target in targets if word & 0x0F == 0x0F]
        steps = [abs(b - a) for a, b in zip(powered, powered[1:])]
        most = velocity / turn * counts * SYNC_S + 1
        report.check(f"node {node}: set-points step by {max(steps)} counts, at most {most:.0f}", max(steps) <= most)
        report.check(f"node {node}: it has moved", max(position for _, position in positions) > 1000)
        status, position = positions[-1]
        report.check(f"node {node}: no power at the end", status & 0x6F == 0x40, hex(status))
        report.check(f"node {node}: back at its start", abs(position) <= 100, position)
        report.equal(f"node {node}: state at the end", replay.nodes[node].nmt.state, "PRE-OPERATIONAL")
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
