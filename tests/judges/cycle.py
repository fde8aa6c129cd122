"""Cyclic exchange at 1 kHz through pysoem, and the bring-up of a whole bus to Op."""

import contextlib
import gc
import os
import time

import pysoem

PERIOD = 1_000_000  # ns
# This computer may stall.
TIMEOUT_US = 10_000_000
NO_FRAME = -1
# SCHED_FIFO: below the kernel threads and above the simulated bus.
PRIORITY = 75

STATES = {1: "Init", 2: "PreOp", 3: "Boot", 4: "SafeOp", 8: "Op"}


def state_name(state):
    return STATES.get(state & 0x0F, hex(state)) + ("+Error" if state & 0x10 else "")


class Cycle:
    """Exchanges process data once a millisecond and counts the replies."""

    def __init__(self, master, expected):
        self.master = master
        self.expected = expected
        self.good = 0
        # No reply in time: the computer stalled, or the frame was lost.
        self.missed = 0
        # A reply with a wrong working counter.
        self.wrong = {}
        self._next = time.monotonic_ns()

    def once(self):
        """True if fresh inputs arrived."""
        self._next += PERIOD
        wait = self._next - time.monotonic_ns()
        if wait > 0:
            time.sleep(wait / 1e9)
        elif wait < -PERIOD:
            # Missed cycles are skipped, not repeated.
            self._next = time.monotonic_ns()
        self.master.send_processdata()
        wkc = self.master.receive_processdata(2_000)
        if wkc == self.expected:
            self.good += 1
            return True
        if wkc == NO_FRAME:
            self.missed += 1
        else:
            self.wrong[wkc] = self.wrong.get(wkc, 0) + 1
        return False

    def run(self, count):
        gc.disable()
        for _ in range(count):
            self.once()
        gc.enable()

    def until(self, condition, seconds):
        """Runs cycles until `condition()` holds. Returns False after the maximum number of cycles."""
        for _ in range(round(seconds * 1e9 / PERIOD)):
            self.once()
            if condition():
                return True
        return False

    def forget(self):
        self.good, self.missed, self.wrong = 0, 0, {}

    def __str__(self):
        return f"{self.good} good, {self.missed} missed, wrong {self.wrong or 'none'}"


@contextlib.contextmanager
def real_time():
    """Sets the priority of a MainDevice."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except OSError as error:
        print(f"     without real-time priority: {error}", flush=True)
    try:
        yield
    finally:
        # Work between two buses runs without this priority.
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def states(master):
    master.read_state()
    return [state_name(slave.state) for slave in master.slaves]


def reach(master, state, timeout_us=TIMEOUT_US):
    """Requests a state of all devices and waits for it. Returns True if every device reaches it."""
    master.state = state
    master.write_state()
    return master.state_check(state, timeout_us) == state


def to_op(master, expected):
    """Leads mapped devices from PreOp to Op with continuous process data. The cycle continues afterwards."""
    if not reach(master, pysoem.SAFEOP_STATE):
        return None
    cycle = Cycle(master, expected)
    cycle.run(20)
    master.state = pysoem.OP_STATE
    master.write_state()

    def in_op():
        # `state_check` sends an additional frame, so it does not run in every cycle.
        return cycle.good % 10 == 0 and master.state_check(pysoem.OP_STATE, 0) == pysoem.OP_STATE

    return cycle if cycle.until(in_op, 10) else None
