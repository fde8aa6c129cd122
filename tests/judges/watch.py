"""Detects stalls of the computer. A virtual machine's host or a neighbour may take processors away for
tens of milliseconds; delays in this time say nothing about the program."""

import ctypes
import ctypes.util
import mmap
import os
import signal
import struct
import time
import traceback

import rig
from report import Stop

EVERY = 0.001
# A later wake-up counts as a stall.
LATE = 0.002
# Above every thread of the program, so that none of them delays the watch.
PRIORITY = 95

TRIES = 3
# The maximum stalled share of a section's time. If every try exceeds it, the section has no result.
TOO_MUCH = 0.1


class Watch:
    """A process on each processor wakes up every millisecond for as long as the block lasts."""

    def __enter__(self):
        self.began = time.monotonic()
        self.results, self.children = [], []
        for cpu in sorted(os.sched_getaffinity(0)):
            results = mmap.mmap(-1, 16)
            child = os.fork()
            if child == 0:
                try:
                    watch(cpu, results)
                finally:
                    os._exit(0)
            self.results.append(results)
            self.children.append(child)
        return self

    def __exit__(self, *_):
        for child in self.children:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
        taken = [struct.unpack("dd", results[:16]) for results in self.results]
        self.longest = max(longest for longest, _ in taken)
        self.share = max(total for _, total in taken) / (time.monotonic() - self.began)


def watch(cpu, results):
    libc = ctypes.CDLL(ctypes.util.find_library("c") or "libc.so.6")
    libc.prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
    os.sched_setaffinity(0, {cpu})
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    longest = total = 0.0
    while True:
        began = time.monotonic()
        time.sleep(EVERY)
        late = time.monotonic() - began - EVERY
        if late > LATE:
            longest, total = max(longest, late), total + late
            results[:] = struct.pack("dd", longest, total)


def retry_if_host_stalled(name, section, report, short=0.0):
    """Repeats a section that fails while the computer stalls, for more than `short` s at once. Without a valid try, the section is
    skipped."""
    fair = False
    for left in reversed(range(TRIES)):
        before = report.mark()
        with Watch() as watch:
            try:
                section()
            except Stop:
                report.note("the rest of this section is left out")
            except rig.Skip:
                raise
            except Exception as error:
                traceback.print_exc()
                report.check(f"{name} comes to its end", False, repr(error))
        if report.well_since(before) or watch.longest <= short:
            return
        fair = fair or watch.share <= TOO_MUCH
        report.note(f"a processor stood still for {watch.share:.1%} of the time, {watch.longest * 1e3:.0f} ms at once")
        if left == 0 and fair:
            return
        report.forget(before)
        if left:
            report.note("once more")
        else:
            rig.count_skip(f"{name}: not one fair try of {TRIES}")
