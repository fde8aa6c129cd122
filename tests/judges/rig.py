"""The test rig: a veth pair, `ecaxis sim` at one end, a recorder at the other."""

import contextlib
import ctypes.util
import os
import pathlib
import re
import signal
import subprocess
import sys
import tempfile
import time

import esi

HERE = pathlib.Path(__file__).resolve().parent
ROOT = HERE.parent.parent
PREFIX = "ecj"


class Skip(Exception):
    """This computer cannot run the test; the program has not failed."""


def count_skip(reason):
    """Prints why something does not run, and adds it to the file that `.ci/run` prints at its end."""
    print(f"skipped: {reason}")
    if file := os.environ.get("ECAXIS_SKIPS"):
        with open(file, "a", encoding="utf-8") as skips:
            skips.write(f"judges: {reason}\n")


def skip(reason):
    """Raises `Skip`, or on CI an error: all that the judges need is there."""
    raise RuntimeError(f"skipped on CI: {reason}") if os.environ.get("CI") else Skip(reason)


def fixture(path):
    """Returns a third-party file for tests. On CI a missing file is a failure."""
    folder = pathlib.Path(os.environ.get("ECAXIS_FIXTURES") or ROOT / "../shared/fixtures")
    file = (folder / path).resolve()
    if file.exists():
        return file
    skip(f"{file} is not here (set ECAXIS_FIXTURES)")


def ip(*arguments):
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"ip {' '.join(arguments)}: {done.stderr.strip()}")


@contextlib.contextmanager
def veth_pair(letters="ab"):
    """Yields the names of two connected interfaces, which are always removed afterwards."""
    if os.geteuid() != 0:
        skip("a veth pair needs root")
    # Interfaces of an earlier, killed run.
    for name in os.listdir("/sys/class/net"):
        left = re.fullmatch(rf"{PREFIX}(\d+)[a-z]", name)
        if left and not os.path.exists(f"/proc/{left[1]}"):
            subprocess.run(["ip", "link", "del", name], capture_output=True)
    a, b = (f"{PREFIX}{os.getpid()}{letter}" for letter in letters)
    try:
        ip("link", "add", a, "type", "veth", "peer", "name", b)
    except (RuntimeError, FileNotFoundError) as error:
        skip(f"no veth pair can be made: {error}")
    try:
        for nic in (a, b):
            # The host sends no address resolution or router solicitation on this wire.
            with contextlib.suppress(OSError):
                pathlib.Path(f"/proc/sys/net/ipv6/conf/{nic}/disable_ipv6").write_text("1")
            ip("link", "set", nic, "up")
        deadline = time.monotonic() + 5
        for nic in (a, b):
            while pathlib.Path(f"/sys/class/net/{nic}/carrier").read_text().strip() != "1":
                if time.monotonic() > deadline:
                    raise RuntimeError(f"{nic} has no carrier")
                time.sleep(0.01)
        yield a, b
    finally:
        subprocess.run(["ip", "link", "del", a], capture_output=True)


def target():
    """Returns the target folder of cargo."""
    return (ROOT / pathlib.Path(os.environ.get("CARGO_TARGET_DIR") or "target")).resolve()


def binary():
    """Returns the program under test: ECAXIS, or the one built by cargo."""
    given = os.environ.get("ECAXIS")
    if given:
        return pathlib.Path(given).resolve()
    profile = os.environ.get("ECAXIS_PROFILE", "dev")
    build = ["cargo", "build", "--quiet", "--bin", "ecaxis", "--profile", profile]
    subprocess.run(build, cwd=ROOT, check=True)
    return target() / ("debug" if profile == "dev" else profile) / "ecaxis"


class Machine:
    """A machine file with the ESI description of each device."""

    def __init__(self):
        self.devices = []
        self.names = []
        self._text = ['[bus]\nnic = "sim"\ncycle = "1ms"\n']

    def add(self, name, path, type_name, revision=None, module=None, more=""):
        device = esi.read(path, type_name, revision, module)
        position = len(self.devices)
        self._text.append(
            f'[[device]]\nname = "{name}"\nesi = "{path}"\ntype = "{type_name}"\n'
            f"revision = {device.revision}\nposition = {position}\n{more}"
        )
        self.devices.append(device)
        self.names.append(name)
        return self

    def index(self, name):
        return self.names.index(name)

    def write(self, folder):
        path = pathlib.Path(folder) / "machine.toml"
        path.write_text("\n".join(self._text))
        return path


def drive(machine, name, path, type_name):
    """A drive whose ESI has a CSP module; encoder and limits as any machine file has them."""
    return machine.add(
        name,
        path,
        type_name,
        module="CSP",
        more='mode = "csp"\n[device.axis]\nunit = "turn"\nencoder = 2000\n'
        "limits = { position = [-1000.0, 1000.0], velocity = 50.0, acceleration = 500.0, "
        "torque = 100.0, following_error = 1.0 }\n",
    )


@contextlib.contextmanager
def process(arguments, **more):
    """A child process that ends with the block or with this process."""
    libc = ctypes.CDLL(ctypes.util.find_library("c") or "libc.so.6")
    die_with_parent = lambda: libc.prctl(1, signal.SIGKILL)  # noqa: E731 PR_SET_PDEATHSIG
    child = subprocess.Popen(arguments, text=True, preexec_fn=die_with_parent, **more)
    try:
        yield child
    finally:
        if child.poll() is None:
            child.kill()
        child.wait()


class Served:
    """A running simulated bus; after `end`, its exit code and output."""

    def __init__(self, child, errors):
        self.child = child
        self.errors = errors
        self.output = None

    def strike(self):
        """Starts the fault script."""
        self.child.send_signal(signal.SIGUSR1)

    def end(self):
        if self.output is None:
            self.child.send_signal(signal.SIGINT)
            try:
                self.output, _ = self.child.communicate(timeout=10)
            except subprocess.TimeoutExpired:
                self.child.kill()
                self.output, _ = self.child.communicate()
        return self.child.returncode, self.output


def wait(condition, seconds=30):
    """Waits until the condition holds. False: it does not hold in this time."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True


@contextlib.contextmanager
def served(program, machine, nic, faults=None, options=()):
    """Runs `ecaxis sim` with this machine on the interface, and waits until it answers."""
    with tempfile.TemporaryDirectory(prefix="ecaxis-judge-") as folder:
        command = [str(program), "sim", str(machine.write(folder)), "--nic", nic, *options]
        if faults:
            script = pathlib.Path(folder) / "faults.toml"
            script.write_text(faults)
            # On a slow computer, a script from the start would affect bring-up.
            command += ["--faults", str(script), "--faults-on-signal"]
        errors = pathlib.Path(folder) / "errors"
        with errors.open("w") as err, process(command, stdout=subprocess.PIPE, stderr=err) as child:
            deadline = time.monotonic() + 20
            while "answer" not in errors.read_text():
                if child.poll() is not None or time.monotonic() > deadline:
                    raise RuntimeError(f"{' '.join(command)}: {errors.read_text()}")
                time.sleep(0.02)
            bus = Served(child, errors)
            yield bus
            bus.end()


def packets(nic, way):
    return int(pathlib.Path(f"/sys/class/net/{nic}/statistics/{way}_packets").read_text())


@contextlib.contextmanager
def recorded(nic, path, steady):
    """Records every frame on the interface in both directions, as pcapng."""
    command = [sys.executable, str(HERE / "recorder.py"), nic, str(path)]
    with process(command, stdout=subprocess.PIPE) as child:
        child.stdout.readline()
        owed = packets(nic, "tx") - packets(nic, "rx")
        yield
        # Waits until every reply is received and written.
        deadline = time.monotonic() + 10
        while steady and packets(nic, "tx") - packets(nic, "rx") > owed and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(0.2)
        child.send_signal(signal.SIGTERM)
        child.wait(timeout=30)
        if child.returncode:
            raise RuntimeError(f"the recorder failed: {child.returncode}")
