#!/usr/bin/env python3
"""The `pyetg1510` package judges the mailbox gateway and the object dictionary of the MainDevice.

`ecaxis run --sim` keeps a bus of nine devices in Op: a coupler, four terminals on one branch, four drives on the other. The
package reads the whole dictionary by SDO Information and complete access. Its values must be those of `ecaxis scan --json`
and of the machine file. Run in an environment with `requirements.txt` installed: `python tests/judges/mailbox_gateway.py`.
"""

import asyncio
import ctypes
import json
import pathlib
import re
import signal
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
        run = [rig.binary(), "run", machine, "--sim", "--no-enable", "--for", "60s", "--json"]
        with rig.process(run, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
            gateway = Gateway(child)
            report.need("the bus is in Op", gateway.ready.wait(30) and gateway.port, gateway.lines[-1:])
            for _ in range(20):
                objects = asyncio.run(dictionary(gateway.port))
                # The rate of frames is known after the first second.
                if objects.get(0xF120, {}).get("CyclicFramesPerSecond", 0) >= 100:
                    break
                time.sleep(0.5)
            child.send_signal(signal.SIGINT)
            summary = json.loads(child.stdout.read())["summary"]
            child.wait(30)
    judge(report, objects, devices)
    report.equal("wrong working counters", summary["counters"]["wkc_errors"], 0)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
