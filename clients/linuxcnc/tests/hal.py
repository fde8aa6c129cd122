"""Runs LinuxCNC's HAL in namespaces of its own: nothing is installed, and several runs do not meet.

`ECAXIS_LINUXCNC` names the folder of the unpacked packages `linuxcnc-uspace` and `linuxcnc-uspace-dev`; without it, the installed
ones are used."""

import os
import pathlib
import shutil
import signal
import subprocess
import time

CLIENTS = pathlib.Path(__file__).resolve().parents[2]
# rtapi_app runs as this user, not as root.
UNPRIVILEGED = "65534"


class Linuxcnc:
    """The installed or unpacked packages, with the component of this folder added."""

    def __init__(self, folder):
        self.folder = pathlib.Path(folder)
        unpacked = os.environ.get("ECAXIS_LINUXCNC")
        self.added = self.folder / "added"
        self.modules = self.added / "lib/linuxcnc/modules"
        self.modules.mkdir(parents=True)
        layers = [str(self.added), *([f"{unpacked}/usr"] if unpacked else []), "/usr"]
        mounts = [f"mount -t overlay overlay -o lowerdir={':'.join(layers)} /usr"]
        if unpacked:
            mounts.append(f"mount -t overlay overlay -o lowerdir={unpacked}/etc:/etc /etc")
        self.script = " && ".join([*mounts, 'exec "$@"'])

    def command(self, *arguments):
        namespaces = ["unshare", "--mount", "--ipc", "--pid", "--fork", "--mount-proc", "--kill-child"]
        return [*namespaces, "sh", "-c", self.script, "sh", *map(str, arguments)]

    def works(self):
        done = subprocess.run(self.command("halcmd", "-h"), capture_output=True)
        return b"Usage" in done.stdout + done.stderr

    def build(self):
        """Builds the component as its README says."""
        sources = self.folder / "sources"
        shutil.copytree(CLIENTS / "c", sources / "c")
        shutil.copytree(CLIENTS / "linuxcnc", sources / "linuxcnc")
        done = subprocess.run(self.command("make", "-C", sources / "linuxcnc"), capture_output=True, text=True)
        assert done.returncode == 0 and "warning" not in done.stderr, done.stdout + done.stderr
        shutil.copy(sources / "linuxcnc/ecaxis.so", self.modules)


class Hal:
    """A running `halrun`, until the end of the block."""

    def __init__(self, linuxcnc, file, path):
        self.linuxcnc, self.file, self.path = linuxcnc, file, path

    def __enter__(self):
        folder = self.path.parent
        self.environment = {
            **os.environ,
            "RTAPI_UID": UNPRIVILEGED,
            "RTAPI_FIFO_PATH": str(folder / "fifo"),
            "HOME": str(folder),
            "ECAXIS_SOCKET": str(self.path),
        }
        self.messages = open(folder / "messages", "w+")
        command = self.linuxcnc.command("halrun", "-I", self.file)
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=self.messages, stderr=self.messages, env=self.environment
        )
        try:
            self.wait_for("ecaxis.connected", True)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *error):
        self.process.stdin.close()
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.messages.close()

    def descendants(self):
        """Returns the processes of HAL with their names."""
        parents = {}
        for entry in os.listdir("/proc"):
            if entry.isdigit():
                try:
                    name, _, rest = pathlib.Path(f"/proc/{entry}/stat").read_text().rpartition(")")
                except OSError:
                    continue
                parents[int(entry)] = (int(rest.split()[1]), name.split("(", 1)[1])
        found = {self.process.pid: "unshare"}
        while more := {p: name for p, (parent, name) in parents.items() if parent in found and p not in found}:
            found.update(more)
        return found

    def signal_rtapi(self, number):
        """Sends a signal to the process of the real-time functions."""
        sent = [pid for pid, name in self.descendants().items() if name.startswith("rtapi_app")]
        assert sent, self.text()
        for pid in sent:
            os.kill(pid, number)

    def halcmd(self, *arguments):
        inner = next((pid for pid, name in self.descendants().items() if name not in ("unshare",)), None)
        if inner is None:
            return subprocess.CompletedProcess(arguments, 1, "", "HAL has not started")
        command = ["nsenter", "-t", str(inner), "--mount", "--ipc", "--pid", "halcmd", "-s", *map(str, arguments)]
        try:
            return subprocess.run(command, capture_output=True, text=True, env=self.environment, timeout=10)
        except subprocess.TimeoutExpired:
            return subprocess.CompletedProcess(arguments, 1, "", "halcmd does not end")

    def set(self, pin, value):
        done = self.halcmd("setp", pin, value)
        assert done.returncode == 0, done.stderr + self.text()

    def get(self, pin):
        text = self.halcmd("getp", pin).stdout.strip()
        return {"TRUE": True, "FALSE": False}.get(text) if text in ("TRUE", "FALSE") else float(text or "nan")

    def wait_for(self, pin, value, timeout=20):
        deadline = time.monotonic() + timeout
        while self.get(pin) != value:
            assert time.monotonic() < deadline, f"{pin} is not {value}: {self.text()}{self.halcmd('show', 'pin').stdout}"
            time.sleep(0.05)

    def text(self):
        self.messages.flush()
        return pathlib.Path(self.messages.name).read_text()


KILL, STOP, CONTINUE = signal.SIGKILL, signal.SIGSTOP, signal.SIGCONT
