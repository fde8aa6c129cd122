#!/usr/bin/env python3
"""A MainDevice that runs ENI files as scripts: it leads the simulated bus to Op with nothing but the file.

Written from ETG.2100 and ETG.1000.4/.6; shares nothing with ecaxis. It sends the init commands of each transition in their
order, checks working counters (`Cnt`) and values (`Validate`), downloads the SDOs, and exchanges the cyclic frames of each state.
One thing is its own, as for every MainDevice: the start time of SYNC0. Needs root, for a veth pair.
"""

import socket
import struct
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as tree
from pathlib import Path

import rig

FPRD, FPWR, LRW, LRD, LWR = 4, 5, 12, 10, 11
START_TIME, SYSTEM_TIME = 0x0990, 0x0910
CYCLES = 200


class Wrong(Exception):
    """The bus does not answer as the file says."""


def number(element, name, default=None):
    text = element.findtext(name)
    if text is None:
        return default
    return int(text[2:], 16) if text.startswith("#x") else int(text)


def address(command):
    logical = number(command, "Addr")
    if logical is not None:
        return logical & 0xFFFFFFFF
    return number(command, "Ado") << 16 | number(command, "Adp", 0) & 0xFFFF


def payload(command):
    data = command.findtext("Data")
    return bytes.fromhex(data) if data is not None else bytes(number(command, "DataLength"))


class Link:
    def __init__(self, nic):
        self.socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(0x88A4))
        self.socket.bind((nic, 0))
        self.socket.settimeout(0.5)
        self.index = 0

    def exchange(self, datagrams):
        """Sends datagrams as (command, address, data) in one frame; returns data and working counter of each."""
        self.index = (self.index + 1) % 256
        body = b""
        for place, (command, target, data) in enumerate(datagrams):
            more = 0x8000 if place + 1 < len(datagrams) else 0
            body += struct.pack("<BBIHH", command, self.index, target, len(data) | more, 0) + data + bytes(2)
        frame = b"\xff" * 6 + bytes.fromhex("101010101030") + b"\x88\xa4" + struct.pack("<H", len(body) | 0x1000) + body
        self.socket.send(frame.ljust(60, b"\0"))
        while True:
            answer = self.socket.recv(2048)
            if answer[6] & 2 and answer[17] == self.index:
                break
        found, at = [], 16
        for _, _, data in datagrams:
            at += 10
            found.append((answer[at : at + len(data)], struct.unpack_from("<H", answer, at + len(data))[0]))
            at += len(data) + 2
        return found


class MainDevice:
    def __init__(self, nic, config):
        self.link = Link(nic)
        self.config = config
        self.state = "INIT"
        self.counters = {}
        self.cycles = 0

    def cycle(self):
        """Sends the cyclic frames of the state; returns a wrong working counter, if there is one."""
        wrong = None
        for frame in self.config.findall("Cyclic/Frame"):
            commands = [c for c in frame.findall("Cmd") if self.state in [s.text for s in c.findall("State")]]
            if not commands:
                continue
            answers = self.link.exchange([(number(c, "Cmd"), address(c), payload(c)) for c in commands])
            for command, (_, counter) in zip(commands, answers):
                if counter != number(command, "Cnt", counter):
                    wrong = f"{command.findtext('Comment')}: working counter {counter}, not {number(command, 'Cnt')}"
        self.cycles += 1
        return wrong

    def command(self, command):
        code, target, data = number(command, "Cmd"), address(command), payload(command)
        station, register = target & 0xFFFF, target >> 16
        if code == FPWR and register == START_TIME:
            [(now, _)] = self.link.exchange([(FPRD, SYSTEM_TIME << 16 | station, bytes(8))])
            slave = next(s for s in self.config.findall("Slave") if number(s, "Info/PhysAddr") == station)
            start = int.from_bytes(now, "little") + 50_000_000 + number(slave, "DC/ShiftTime")
            data = start.to_bytes(8, "little")
        validate, expected = command.find("Validate"), number(command, "Cnt")
        deadline = time.monotonic() + (number(validate, "Timeout") / 1000 if validate is not None else 0)
        tries = 0
        while True:
            [(answer, counter)] = self.link.exchange([(code, target, data)])
            tries += 1
            counted = expected is None or counter == expected
            if counted and (validate is None or matches(answer, validate)):
                return
            if (not counted and tries > number(command, "Retries", 0)) or (counted and time.monotonic() > deadline):
                raise Wrong(f"{command.findtext('Comment')} at {register:#06x}: {answer.hex()}, working counter {counter}")
            self.cycle()

    def download(self, slave, command, counter):
        """Writes one SDO, expedited or at once."""
        station, name = number(slave, "Info/PhysAddr"), slave.findtext("Info/Name")
        data, index, sub = payload(command), number(command, "Index"), number(command, "SubIndex")
        whole = 0x10 if command.get("CompleteAccess") in ("1", "true") else 0
        if len(data) <= 4:
            sdo = struct.pack("<BHB", 0x23 | (4 - len(data)) << 2 | whole, index, sub) + data.ljust(4, b"\0")
        else:
            sdo = struct.pack("<BHBI", 0x21 | whole, index, sub, len(data)) + data
        message = struct.pack("<HHBBH", len(sdo) + 2, 0, 0, 3 | counter << 4, 0x2000) + sdo
        send, receive = slave.find("Mailbox/Send"), slave.find("Mailbox/Recv")
        message = message.ljust(number(send, "Length"), b"\0")
        [(_, counted)] = self.link.exchange([(FPWR, number(send, "Start") << 16 | station, message)])
        if counted != 1:
            raise Wrong(f"{name}: the mailbox takes no message")
        deadline = time.monotonic() + number(command, "Timeout") / 1000
        while time.monotonic() < deadline:
            self.cycle()
            target = number(receive, "Start") << 16 | station
            [(answer, counted)] = self.link.exchange([(FPRD, target, bytes(number(receive, "Length")))])
            service = struct.unpack_from("<H", answer, 6)[0] >> 12
            if counted != 1 or service != 3:
                continue
            if answer[8] == 0x60 and struct.unpack_from("<HB", answer, 9) == (index, sub):
                return
            raise Wrong(f"{name}: SDO {index:#06x}:{sub:02x}: {answer[8:16].hex()}")
        raise Wrong(f"{name}: SDO {index:#06x}:{sub:02x}: no answer")

    def transition(self, name, reached):
        def due(command):
            return name in [t.text for t in command.findall("Transition")]

        for command in self.config.findall("Master/InitCmds/InitCmd"):
            if due(command) and number(command, "BeforeSlave", 0):
                self.command(command)
        for slave in self.config.findall("Slave"):
            sdos = [c for c in slave.findall("Mailbox/CoE/InitCmds/InitCmd") if due(c)]
            # The mailbox begins with PreOp.
            if name == "IP":
                self.commands(slave, due)
            for command in sdos:
                station = number(slave, "Info/PhysAddr")
                self.counters[station] = self.counters.get(station, 0) % 7 + 1
                self.download(slave, command, self.counters[station])
            if name != "IP":
                self.commands(slave, due)
        self.state = reached

    def commands(self, slave, due):
        for command in slave.findall("InitCmds/InitCmd"):
            if due(command):
                self.command(command)


def matches(answer, validate):
    wanted = bytes.fromhex(validate.findtext("Data"))
    mask = bytes.fromhex(validate.findtext("DataMask") or "ff" * len(wanted))
    return all(a & m == w & m for a, w, m in zip(answer, wanted, mask))


def judge(nic, bus):
    """Leads the bus to Op; returns the number of cycles in Op with the right working counters."""
    main = MainDevice(nic, tree.parse(bus).getroot().find("Config"))
    for name, state in [("IP", "PREOP"), ("PS", "SAFEOP")]:
        main.transition(name, state)
    for _ in range(50):
        main.cycle()
    main.transition("SO", "OP")
    for count in range(CYCLES):
        if wrong := main.cycle():
            raise Wrong(f"cycle {count}: {wrong}")
        time.sleep(0.001)
    # And back, as the file says.
    main.state = "SAFEOP"
    main.transition("OS", "SAFEOP")
    main.transition("SI", "INIT")
    return CYCLES


class Sample:
    """A sample machine for `rig.served`."""

    def __init__(self, path):
        self.path = path

    def write(self, _):
        return self.path


def main():
    program = rig.binary()
    wrong = []
    try:
        with rig.veth_pair() as (near, far), tempfile.TemporaryDirectory() as folder:
            for file in sorted((rig.ROOT / "configs").glob("*.toml")):
                # Tools that are absent count as well.
                if "optional" in file.read_text():
                    continue
                name, bus = file.name, Path(folder, "bus.xml")
                subprocess.run([program, "eni", file, "-o", bus, "--force"], check=True, stderr=subprocess.DEVNULL)
                with rig.served(program, Sample(file), far):
                    try:
                        print(f"{name}: Op, {judge(near, bus)} cycles with the working counters of the file")
                    except (Wrong, TimeoutError) as error:
                        wrong.append(f"{name}: {error}")
    except rig.Skip as reason:
        rig.count_skip(str(reason))
        return 0
    print("\n".join(wrong))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
