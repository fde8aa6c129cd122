"""Two halves of a network in namespaces: hosts at two switches with a trunk between them, with delay and loss on every link.

Each host has a TAP interface; a thread is both switches. Not every kernel has netem.
"""

import contextlib
import fcntl
import heapq
import os
import random
import selectors
import struct
import subprocess
import threading
import time

import rig

# Of each link at first; a frame to another host passes two of them, one to the other half three.
DELAY_S = (0.003, 0.007)
LOSS = 0.01
TUNSETIFF, IFF_TAP, IFF_NO_PI = 0x400454CA, 0x0002, 0x1000


class Host:
    """A namespace with an address and the processes in it."""

    def __init__(self, hall, half, number):
        self.half, self.name = half, f"{hall.name}-{number}"
        self.address = f"10.77.{number // 250}.{number % 250 + 1}"
        self.connected, self.processes = True, []
        tap = f"ecf{os.getpid() % 100000}n{number}"
        rig.ip("netns", "add", self.name)
        self.tap = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
        fcntl.ioctl(self.tap, TUNSETIFF, struct.pack("16sH22x", tap.encode(), IFF_TAP | IFF_NO_PI))
        rig.ip("link", "set", tap, "netns", self.name)
        rig.ip("-n", self.name, "addr", "add", f"{self.address}/16", "dev", tap)
        for link in ("lo", tap):
            rig.ip("-n", self.name, "link", "set", link, "up")

    def start(self, command, log, **options):
        command = ["ip", "netns", "exec", self.name, *map(str, command)]
        with open(log or os.devnull, "ab") as file:
            options = {"stdout": file, "stderr": file, **options}
            self.processes.append(subprocess.Popen(command, stdin=subprocess.DEVNULL, **options))
        return self.processes[-1]

    def run(self, command):
        command = ["ip", "netns", "exec", self.name, *map(str, command)]
        return subprocess.run(command, capture_output=True, text=True, timeout=60)

    def remove(self):
        for process in self.processes:
            process.kill()
            process.wait()
        subprocess.run(["ip", "netns", "del", self.name], capture_output=True)
        os.close(self.tap)


class Switches:
    """Forwards frames between the hosts."""

    def __init__(self, seed):
        self.random, self.trunk, self.running = random.Random(seed), True, True
        self.hosts, self.addresses, self.due, self.last = [], {}, [], {}
        self.delay, self.loss = DELAY_S, LOSS
        self.count = self.lost = 0
        self.selector = selectors.DefaultSelector()
        self.thread = threading.Thread(target=self.run, daemon=True)

    def add(self, host):
        self.hosts.append(host)
        self.selector.register(host.tap, selectors.EVENT_READ, host)

    def run(self):
        while self.running:
            wait = self.due[0][0] - time.monotonic() if self.due else 0.05
            for key, _ in self.selector.select(min(max(wait, 0.0), 0.05)):
                for _ in range(64):
                    try:
                        self.forward(key.data, os.read(key.fd, 65536))
                    except OSError:
                        break
            while self.due and self.due[0][0] <= time.monotonic():
                *_, host, frame = heapq.heappop(self.due)
                if host.connected:
                    with contextlib.suppress(OSError):
                        os.write(host.tap, frame)

    def forward(self, source, frame):
        to, self.addresses[frame[6:12]] = frame[:6], source
        known = self.addresses.get(to)
        for host in [known] if known else self.hosts:
            across = host.half != source.half
            if host is source or not source.connected or across and not self.trunk:
                continue
            links = 3 if across else 2
            self.count += 1
            if self.random.random() < 1 - (1 - self.loss) ** links:
                self.lost += 1
                continue
            # The frames of a link stay in their order.
            due = time.monotonic() + sum(self.random.uniform(*self.delay) for _ in range(links))
            due = self.last[source, host] = max(due, self.last.get((source, host), 0.0))
            heapq.heappush(self.due, (due, self.count, host, frame))


class Hall:
    """The network."""

    def __init__(self, seed):
        self.name = f"ecf{os.getpid()}"
        self.switches, self.hosts, self.commands = Switches(seed), [], {}

    def __enter__(self):
        try:
            self.routers = {half: self.host(half) for half in ("left", "right")}
            self.commands = {half: self.host(half) for half in ("left", "right")}
        except (RuntimeError, OSError) as error:
            self.__exit__()
            rig.skip(f"no network namespaces can be made: {error}")
        self.switches.thread.start()
        return self

    def __exit__(self, *_):
        self.switches.running = False
        if self.switches.thread.is_alive():
            self.switches.thread.join()
        for host in self.hosts:
            host.remove()

    def host(self, half):
        """A new host in one half."""
        self.hosts.append(Host(self, half, len(self.hosts) + 1))
        self.switches.add(self.hosts[-1])
        return self.hosts[-1]

    def router(self, half):
        return f"tcp/{self.routers[half].address}:7447"
