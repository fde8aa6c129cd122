"""Checks a recording with Wireshark's dissector, through tshark."""

import shutil
import subprocess
from collections import Counter

# SOEM sends from 01:01:01:01:01:01, which has the group bit set; the bus passes it on.
SOEM_SOURCE = "Source MAC must not be a group address"


def available():
    return shutil.which("tshark") is not None


def dissect(path):
    """Returns (frames, dissected as EtherCAT, malformed, Counter of expert messages)."""
    fields = ["frame.protocols", "_ws.malformed", "_ws.expert.severity", "_ws.expert.message"]
    command = ["tshark", "-n", "-r", str(path), "-T", "fields", "-E", "aggregator=|"]
    for name in fields:
        command += ["-e", name]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    frames = ethercat = malformed = 0
    remarks = Counter()
    for line in done.stdout.splitlines():
        protocols, broken, severity, messages = (line.split("\t") + [""] * 4)[:4]
        frames += 1
        ethercat += "ecat" in protocols.split(":")
        malformed += bool(broken) or "_ws.malformed" in protocols
        for level, message in zip(severity.split("|"), messages.split("|")):
            if level:
                remarks[(int(level, 0), message)] += 1
    return frames, ethercat, malformed, remarks


def remarks_but_soem(remarks):
    return {text: n for (_, text), n in remarks.items() if not text.startswith(SOEM_SOURCE)}
