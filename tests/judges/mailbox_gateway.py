#!/usr/bin/env python3
"""The `pyetg1510` package judges the mailbox gateway and the object dictionary of the MainDevice.

`ecaxis run --sim` keeps a bus of nine devices in Op: a coupler, four terminals on one branch, four drives on the other. The
package reads the whole dictionary by SDO Information and complete access. Its values must be those of `ecaxis scan --json`
and of the machine file. Wireshark's dissector reads every datagram of this exchange. Then a million damaged datagrams arrive
at the port: the dictionary is the same afterwards, and no cycle is late or has a wrong working counter. Run in an environment with `requirements.txt` installed: `python tests/judges/mailbox_gateway.py`.
"""

import asyncio
import ctypes
import json
import pathlib
import random
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import fields

import rig
from pyetg1510 import ETG1510Profile, EtherCATMasterConnection, LoggingLevel, MasterODSpecification, SysLog
from pyetg1510.mailbox.sdo_application_interface import SdoDataController
from report import Report

TERMINALS = (("coupler", "CP0"), ("switches", "DI8"), ("valves", "DO8"), ("doors", "DI4"), ("lamps", "DO4"))
DRIVES = (("x", "EPOS4"), ("y", "EPOS4"), ("z", "IDX"), ("w", "IDX"))
HEAD = """
[bus]
nic = "sim"
cycle = "2ms"
lost_frames = 1000
watchdog = "6s"
[mailbox_gateway]
bind = "127.0.0.1:0"
"""
AXIS = """mode = "csp"
[device.axis]
encoder = 2000
limits = { position = [-10.0, 10.0], velocity = 10.0, acceleration = 100.0, torque = 100.0, following_error = 1.0 }
"""
OP = 8
PORT = 0x88A4
DAMAGED = 1_000_000
# 1100: EtherCAT MainDevice; 5001: modular device profile.
DEVICE_TYPE = 1100 << 16 | 5001
PROTOCOLS = ("AoE", "EoE", "CoE", "FoE", "SoE", "VoE")


class EtherCATHeader(ctypes.Structure):
    _fields_ = [("Length", ctypes.c_uint16, 11), ("Reserved", ctypes.c_uint16, 1), ("DataType", ctypes.c_uint16, 4)]


class CoEHeader(ctypes.Structure):
    _fields_ = [("Number", ctypes.c_uint16, 9), ("Reserved", ctypes.c_uint16, 3), ("Service", ctypes.c_uint16, 4)]


def with_headers_of_one_type(controller, sdo_metadata, original=SdoDataController._object_initialization):
    """The package mixes types in its bit fields. That is right on Windows only: elsewhere ctypes loses their bits."""
    original(controller, sdo_metadata)
    for message in (controller.request_message, controller.response_message):
        message.ethercat_header, message.coe_header = EtherCATHeader(), CoEHeader()


SdoDataController._object_initialization = with_headers_of_one_type


def write_machine(folder):
    esi = rig.ROOT / "configs/esi"
    text = HEAD
    for position, (name, kind) in enumerate(TERMINALS + DRIVES):
        file = "terminals" if position < len(TERMINALS) else kind
        text += f'[[device]]\nname = "{name}"\nesi = "{esi}/{file}.xml"\ntype = "{kind}"\nposition = {position}\n'
        text += AXIS if position >= len(TERMINALS) else ""
    path = pathlib.Path(folder) / "machine.toml"
    path.write_text(text)
    return path


class Gateway:
    """Reads the messages of `ecaxis run` until the bus is in Op."""

    def __init__(self, child):
        self.port, self.lines = None, []
        self.ready = threading.Event()
        self.thread = threading.Thread(target=self.read, args=(child.stderr,), daemon=True)
        self.thread.start()

    def read(self, stream):
        for line in stream:
            self.lines.append(line)
            if found := re.search(r"mailbox gateway: 127\.0\.0\.1:(\d+)", line):
                self.port = int(found[1])
            # The status line follows after the first cycles in Op.
            if self.port and re.search(r"cycle \d{3,}", line):
                self.ready.set()
        self.ready.set()


class Relay:
    """Passes the datagrams of one client to the gateway and back, and keeps them."""

    def __init__(self, port):
        self.port, self.seen, self.client = port, [], None
        self.front, self.back = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        self.front.bind(("127.0.0.1", 0))
        self.back.connect(("127.0.0.1", port))
        for pass_on in (self.requests, self.answers):
            threading.Thread(target=pass_on, daemon=True).start()

    def requests(self):
        while True:
            data, self.client = self.front.recvfrom(4096)
            self.seen.append((True, data))
            self.back.send(data)

    def answers(self):
        while True:
            data = self.back.recv(4096)
            self.seen.append((False, data))
            self.front.sendto(data, self.client)

    def write(self, path):
        """Writes a recording of IP packets (link type 101), at the port of the standard."""
        with open(path, "wb") as file:
            file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 101))
            for number, (request, data) in enumerate(self.seen):
                ports = (50000, PORT) if request else (PORT, 50000)
                datagram = struct.pack(">HHHH", *ports, 8 + len(data), 0) + data
                here = bytes((127, 0, 0, 1))
                packet = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(datagram), number & 0xFFFF, 0, 64, 17, 0, here, here)
                packet += datagram
                file.write(struct.pack("<IIII", number // 1000, number % 1000, len(packet), len(packet)) + packet)


def judge_recording(report, path, count):
    """Every datagram is a mailbox telegram to its last byte."""
    if not shutil.which("tshark"):
        print("skipped: no tshark")
        return
    fields = ["frame.protocols", "_ws.malformed", "ecat_mailbox.length", "udp.length", "data.len"]
    command = ["tshark", "-n", "-r", path, "-T", "fields", *(part for field in fields for part in ("-e", field))]
    lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    rows = [(line.split("\t") + [""] * 4)[:5] for line in lines]
    telegrams = [row for row in rows if "ecat_mailbox" in row[0].split(":")]
    report.equal("datagrams that tshark reads as mailbox telegrams", len(telegrams), count)
    report.equal("malformed", sum("malformed" in row[0] or bool(row[1]) for row in rows), 0)
    # UDP, the EtherCAT header and the header of the telegram: 16 bytes.
    whole = sum(int(length) + 16 == int(udp) and not data for _, _, length, udp, data in telegrams)
    report.equal("dissected to the last byte", whole, count)


def damaged(seen, seed=1):
    """Yields datagrams with wrong bytes, lengths or both, from real requests and from nothing."""
    chance = random.Random(seed)
    requests = [data for request, data in seen if request]
    for _ in range(DAMAGED):
        kind = chance.randrange(4)
        if kind == 0:
            yield chance.randbytes(chance.randrange(64))
            continue
        data = bytearray(chance.choice(requests))
        for _ in range(chance.randrange(1, 4)):
            data[chance.randrange(len(data))] = chance.randrange(256)
        yield bytes(data[: chance.randrange(len(data) + 1)]) if kind == 1 else bytes(data)


def send_damaged(port, seen):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as to:
        return sum(to.sendto(datagram, ("127.0.0.1", port)) >= 0 for datagram in damaged(seen))


async def dictionary(port):
    """Returns {index: {name of the entry: value}} of what the MainDevice has."""
    description = MasterODSpecification(EtherCATMasterConnection("127.0.0.1", port))
    await description.get_object_dictionary()
    objects = {}
    async for index, data in ETG1510Profile(description):
        entries = [(field.name, getattr(data, field.name)) for field in fields(data)]
        objects[index] = {name: entry.value for name, entry in entries if entry.enable}
    return objects


def judge_device(report, number, found, objects, devices):
    name, kind = (TERMINALS + DRIVES)[number]
    stations = {device["position"]: device["station"] for device in devices}
    configuration, information, diagnosis = (objects.get(first + number, {}) for first in (0x8000, 0x9000, 0xA000))
    expected = {
        "FixedStationAddress": found["station"],
        "Name": name,
        "Type": found["name"],
        "VendorId": found["vendor"],
        "ProductCode": found["product"],
        "RevisionNumber": found["revision"],
        "MailboxProtocolsSupported": sum(1 << bit for bit, one in enumerate(PROTOCOLS) if one in found["mailbox"]),
        "LinkStatus": 0,
        "Flags": 0,
    }
    report.equal(f"{name}: configuration", {key: configuration.get(key) for key in expected}, expected)
    expected = {
        "StationAddress": found["station"],
        "VendorId": found["vendor"],
        "ProductCode": found["product"],
        "RevisionNumber": found["revision"],
        "SerialNumber": found["serial"],
    }
    report.equal(f"{name}: information", {key: information.get(key) for key in expected}, expected)
    neighbours = [0] * 4
    if found["parent"]:
        neighbours[0] = stations[found["parent"]["position"]]
    for other in devices:
        if other["parent"] and other["parent"]["position"] == number:
            neighbours[other["parent"]["port"]] = other["station"]
    ports = found["ports"]
    expected = {
        "ALStatus": OP,
        "ALControl": OP,
        "ALStatusCode": 0,
        "LinkConnStatus": sum(port["open"] << bit | port["link"] << (4 + bit) for bit, port in enumerate(ports)),
        "FixedAddressConnPort": neighbours,
        "FrameErrorCounterPort": [0] * 4,
        "SlaveNotPresentCounter": 0,
        "AbnormalStateChangeCounter": 0,
    }
    report.equal(f"{name}: diagnosis", {key: diagnosis.get(key) for key in expected}, expected)


def judge(report, objects, devices):
    count = len(devices)
    first = (0x1000, 0x1008, 0x1009, 0x100A, 0x1018, 0xF002, 0xF020, 0xF120)
    expected = sorted([*first, *(group + number for group in (0x8000, 0x9000, 0xA000) for number in range(count))])
    report.equal("objects", sorted(objects), expected, lambda indices: f"{len(indices)} of them")
    report.equal("device type", objects[0x1000]["DeviceType"], DEVICE_TYPE)
    report.equal("name", objects[0x1008]["DeviceName"], "ecaxis")
    version = subprocess.run([rig.binary(), "--version"], check=True, capture_output=True, text=True).stdout
    report.check("software version", objects[0x100A]["SoftwareVersion"] in version, version.strip())
    report.equal("entries of the identity", objects[0x1018]["NumberOfEntries"], 4)
    for number, found in enumerate(devices):
        judge_device(report, number, found, objects, devices)
    addresses = objects[0xF020]
    report.equal("number of configured addresses", addresses["NumberofSlaves"], count)
    stations = [device["station"] for device in devices]
    report.equal("configured addresses", addresses["ConfiguredAddress"][:count], stations)
    master = objects[0xF120]
    report.equal("lost frames", master["CyclicLostFrames"], 0)
    report.equal("state of the MainDevice", master["MasterState"], OP)
    rate = master["CyclicFramesPerSecond"]
    report.check("frames per second, 500 at most", 100 <= rate <= 510, rate)


def main():
    report = Report()
    report.section("nine devices in Op, judged by pyetg1510")
    SysLog.set_loglevel(LoggingLevel.CRITICAL)
    with tempfile.TemporaryDirectory(prefix="ecaxis-judge-") as folder:
        machine = write_machine(folder)
        scan = [rig.binary(), "scan", "--sim", machine, "--json"]
        devices = json.loads(subprocess.run(scan, check=True, capture_output=True, text=True).stdout)["devices"]
        run = [rig.binary(), "run", machine, "--sim", "--no-enable", "--for", "120s", "--json"]
        with rig.process(run, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
            gateway = Gateway(child)
            report.need("the bus is in Op", gateway.ready.wait(30) and gateway.port, gateway.lines[-1:])
            relay = Relay(gateway.port)
            relay_port = relay.front.getsockname()[1]
            for _ in range(20):
                relay.seen.clear()
                objects = asyncio.run(dictionary(relay_port))
                # The rate of frames is known after the first second.
                if objects.get(0xF120, {}).get("CyclicFramesPerSecond", 0) >= 100:
                    break
                time.sleep(0.5)
            seen = list(relay.seen)
            recording = pathlib.Path(folder) / "gateway.pcap"
            relay.write(recording)
            judge_recording(report, recording, len(seen))
            report.equal("damaged datagrams sent", send_damaged(gateway.port, seen), DAMAGED)
            again = asyncio.run(dictionary(gateway.port))
            child.send_signal(signal.SIGINT)
            summary = json.loads(child.stdout.read())["summary"]
            child.wait(30)
    judge(report, objects, devices)
    report.equal("objects after the damaged datagrams", sorted(again), sorted(objects), len)
    for number in range(len(devices)):
        judge_device(report, number, devices[number], again, devices)
    report.equal("cycles without answer", summary["counters"]["lost_frames"], 0)
    report.equal("wrong working counters", summary["counters"]["wkc_errors"], 0)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
