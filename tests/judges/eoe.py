#!/usr/bin/env python3
"""The network stack of Linux judges EoE: a browser's view of simulated drives, through a TAP interface.

`ecaxis run` moves two simulated drives with web pages in real time. urllib opens the page of each drive through the TAP
interface while the axes move, with several connections at the same time and in both directions at once. The kernel has
resolved the addresses (ARP) and counts the frames of the interface. Afterwards the interface is gone. Needs root and
/dev/net/tun: `python tests/judges/eoe.py`.
"""

import concurrent.futures
import json
import os
import pathlib
import re
import socket
import struct
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request

import rig
from report import Report

HOSTS = {"x": "192.168.197.11", "y": "192.168.197.12"}
TAP = f"ecj{os.getpid()}"[:15]
# A computer of tests stalls for tenths of a second.
TOLERANT = 'lost_frames = 1000\nwatchdog = "6s"'


def machine(folder):
    """configs/web.toml with other addresses, and axes that move all the time."""
    text = (rig.ROOT / "configs/web.toml").read_text()
    text = text.replace('"esi/', f'"{rig.ROOT}/configs/esi/').replace("192.168.7.", "192.168.197.")
    text = text.replace('tap     = "ecat0"', f'tap = "{TAP}"')
    text = re.sub(r"lost_frames = 20 .*", TOLERANT, text)
    path = folder / "web.toml"
    path.write_text(text)
    return path


def page(host, path="/"):
    with urllib.request.urlopen(f"http://{host}{path}", timeout=20) as answer:
        return answer.status, answer.headers["Content-Type"], answer.read().decode()


def row(text, name):
    found = re.search(rf"<td>{name}</td><td>([^<]*)</td>", text)
    return found and found[1]


def enabled(host):
    """Returns whether the page is there and says so. URLError is an OSError."""
    try:
        return row(page(host)[2], "axis 1") == "OperationEnabled"
    except OSError:
        return False


def ping(host, count=10):
    """Returns how many echoes come back, by a raw socket of this program."""
    def checksum(data):
        total = sum(struct.unpack(f"!{len(data) // 2}H", data))
        total = (total >> 16) + (total & 0xFFFF)
        return ~(total + (total >> 16)) & 0xFFFF

    back = 0
    with socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_ICMP) as raw:
        raw.settimeout(5)
        for number in range(count):
            head = struct.pack("!BBHHH", 8, 0, 0, os.getpid() & 0xFFFF, number)
            data = bytes(1000)
            head = struct.pack("!BBHHH", 8, 0, checksum(head + data), os.getpid() & 0xFFFF, number)
            raw.sendto(head + data, (host, 0))
            deadline = time.monotonic() + 5
            while time.monotonic() < deadline:
                try:
                    answer, (source, _) = raw.recvfrom(2048)
                except TimeoutError:
                    break
                kind, _, _, ident, sequence = struct.unpack("!BBHHH", answer[20:28])
                if (source, kind, ident, sequence) == (host, 0, os.getpid() & 0xFFFF, number):
                    back += answer[28:] == data
                    break
    return back


def wait_for(condition, child, timeout=30):
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline and child.poll() is None:
        if condition():
            return True
        time.sleep(0.05)
    return False


def judge(report):
    program = rig.binary()
    report.section("EoE: pages of drives through a TAP interface")
    with tempfile.TemporaryDirectory(prefix="ecaxis-judge-") as temporary:
        folder = pathlib.Path(temporary)
        command = [str(program), "run", str(machine(folder)), "--no-fault-report", "--json"]
        tap = pathlib.Path("/sys/class/net") / TAP
        with (folder / "errors").open("w") as errors, rig.process(command, stdout=subprocess.PIPE, stderr=errors) as child:
            there = wait_for(tap.exists, child)
            report.need("the interface exists", there, (folder / "errors").read_text()[-500:])
            moves = wait_for(lambda: enabled(HOSTS["x"]), child)
            report.need("the page says Operation enabled", moves)
            positions = set()
            for _ in range(10):
                status, kind, text = page(HOSTS["x"])
                report.equal("status", (status, kind), (200, "text/html; charset=utf-8"))
                positions.add(row(text, "position"))
                time.sleep(0.1)
            report.check("the axis moves meanwhile", len(positions) > 3, f"{len(positions)} positions")
            with concurrent.futures.ThreadPoolExecutor(4) as pool:
                every = [HOSTS[name] for name in "xy" for _ in range(12)]
                titles = [re.search("<h1>(.*)</h1>", text)[1] for _, _, text in pool.map(page, every)]
            report.equal("pages of both at the same time", titles, ["SV1"] * 24)
            try:
                page(HOSTS["y"], "/missing")
                missing = None
            except urllib.error.HTTPError as error:
                missing = error.code
            report.equal("a page that is missing", missing, 404)
            report.equal("echoes of 1000 bytes", ping(HOSTS["y"]), 10)
            neighbours = subprocess.run(["ip", "neigh", "show", "dev", TAP], capture_output=True, text=True).stdout
            known = re.findall(r"(\S+) lladdr (02:45:43:\S+)", neighbours)
            report.equal("addresses that the kernel has resolved", sorted(host for host, _ in known), sorted(HOSTS.values()))
            counts = [int((tap / "statistics" / name).read_text()) for name in ("rx_errors", "tx_errors")]
            report.equal("errors of the interface", counts, [0, 0])
            child.send_signal(2)
            output, _ = child.communicate(timeout=30)
        report.check("the interface is gone", not tap.exists())
        summary = json.loads(output)["summary"]
        report.equal("wrong working counters", summary["counters"]["wkc_errors"], 0)
        ports = {port["name"]: port for port in summary["ethernet"]}
        report.equal("ports of the switch", sorted(ports), sorted(["x", "y", TAP]))
        for name in HOSTS:
            dropped = {key: ports[name][key] for key in ("invalid", "incomplete", "not_taken")}
            report.equal(f"frames of {name} that were dropped", dropped, {"invalid": 0, "incomplete": 0, "not_taken": 0})


def main():
    report = Report()
    try:
        if os.geteuid() != 0:
            rig.skip("a TAP interface needs root")
        if not os.path.exists("/dev/net/tun"):
            rig.skip("this computer has no /dev/net/tun")
        judge(report)
    except rig.Skip as skip:
        rig.count_skip(skip)
        return 0
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
