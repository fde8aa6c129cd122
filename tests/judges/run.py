#!/usr/bin/env python3
"""Other people's tools judge the simulated bus.

pysoem (SOEM's MainDevice) brings a bus up that `ecaxis sim` serves on one end of a veth pair, and
works with it; so do ethercrab and, over a ring, KickCAT, more briefly. Emitted EEPROM images are read by both, and by SOEM's slaveinfo.
Chromium opens the page of `ecaxis serve` and those of `ecaxis analyze` and `ecaxis bench`. Foxglove's client, `mcap` and `rosbags` read its values. Run in an environment with `requirements.txt` installed, as root:

    python tests/judges/run.py [SECTION …] [--keep FOLDER] [--all]

What is missing, root included, is an error with CI set, otherwise a reason to skip. ECAXIS names the program to judge; without it, cargo builds it
(ECAXIS_PROFILE: dev).
"""

import argparse
import os
import pathlib
import signal
import sys
import tempfile

import rig
from report import Report
from watch import retry_if_host_stalled

SECTIONS = ["bringup", "overlap", "mailbox", "parameters", "operation", "oddities", "quirks", "faults", "chain", "ring", "kickcat", "gateway", "ethercrab", "eeproms", "recordings", "page", "reports", "monitoring", "service", "rights", "viewers"]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sections", nargs="*", choices=[[], *SECTIONS], metavar="SECTION")
    parser.add_argument("--keep", help="folder that keeps the recordings")
    parser.add_argument("--all", action="store_true", help="every device of every ESI file, not samples")
    arguments = parser.parse_args()
    # SIGTERM must run the `finally` blocks, which remove the interfaces.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    report = Report()
    try:
        run(arguments, report)
    except rig.Skip as skip:
        rig.count_skip(skip)
        return 0
    return report.finish()


def run(arguments, report):
    if os.geteuid() != 0:
        rig.skip("the judges need root")
    try:
        import pysoem  # noqa: F401
    except ImportError as error:
        rig.skip(f"{error}; pip install -r tests/judges/requirements.txt")
    import sections

    program = rig.binary()
    with tempfile.TemporaryDirectory(prefix="ecaxis-judge-") as temporary, rig.veth_pair() as nics:
        folder = pathlib.Path(arguments.keep or temporary)
        folder.mkdir(parents=True, exist_ok=True)
        bench = sections.Bench(program, *nics, folder, report, arguments.all)
        for name in arguments.sections or SECTIONS:
            retry_if_host_stalled(name, lambda section=getattr(sections, name): section(bench), report)


if __name__ == "__main__":
    sys.exit(main())
