"""The shipped examples with mutual TLS and access control: who may not read reads nothing, who may read commands nothing."""

import contextlib
import json
import os
import pathlib
import re
import shutil
import socket
import subprocess
import tempfile
import threading
import time
import urllib.error
import urllib.request

import rig

NAMES = ["router", "press-3", "press-4", "archive", "reader", "planner", "stranger"]
ALL = "ecaxis/**"
KEY = "ecaxis/hall-1/press-3"


def openssl(*arguments):
    subprocess.run(["openssl", *map(str, arguments)], check=True, capture_output=True)


def authority(folder, names):
    """Makes a certificate authority and a certificate for each name."""
    folder.mkdir()
    key = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "2"]
    ca = ["-keyout", folder / "ca.key", "-out", folder / "ca.pem", "-subj", "/CN=test authority"]
    openssl("req", "-x509", *key, *ca)
    for name in names:
        files = ["-keyout", folder / f"{name}.key", "-out", folder / f"{name}.pem", "-subj", f"/CN={name}"]
        host = ["-addext", "subjectAltName=DNS:localhost", "-addext", "basicConstraints=critical,CA:FALSE"]
        openssl("req", "-x509", "-CA", folder / "ca.pem", "-CAkey", folder / "ca.key", *key, *files, *host)


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Client:
    """A session of Python's Zenoh with a certificate. It hears what it may."""

    def __init__(self, endpoint, tls, name):
        import zenoh

        certificate = {"connect_certificate": f"{tls}/{name}.pem", "connect_private_key": f"{tls}/{name}.key"} if name else {}
        link = {"tls": {"root_ca_certificate": f"{tls}/ca.pem", "enable_mtls": bool(name), **certificate}}
        config = {"mode": "client", "connect": {"endpoints": [endpoint], "timeout_ms": 3000}, "transport": {"link": link}}
        config["scouting"] = {"multicast": {"enabled": False}}
        self.session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
        self.heard, self.lock = [], threading.Lock()
        declare = [self.session.declare_subscriber, self.session.liveliness().declare_subscriber]
        keys = [ALL, f"{KEY}/state", "ecaxis/*/*/state", "ecaxis/*/*/event/*"], [ALL, "ecaxis/*/*/alive"]
        self.declared = [function(key, self.hear) for function, own in zip(declare, keys) for key in own]

    def hear(self, sample):
        with self.lock:
            self.heard.append((str(sample.key_expr), sample.payload.to_string()))

    def ask(self, selector, payload=None):
        replies = self.session.get(selector, payload=payload, timeout=2.0)
        return [reply.ok.payload.to_string() for reply in replies if reply.ok]

    def alive(self):
        replies = self.session.liveliness().get("ecaxis/*/*/alive", timeout=2.0)
        return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok)

    def close(self):
        self.session.close()


def page(report, program, folder):
    """The fleet page in a browser: a tile with the state, and a link to the machine's own page."""
    command = [program, "page", "--http", "127.0.0.1:0", "--config", folder / "client.toml"]
    with rig.process(list(map(str, command)), stdout=subprocess.PIPE) as process:
        url = process.stdout.readline().strip()
        machines = json.load(urllib.request.urlopen(f"{url}api/fleet", timeout=20))
        report.equal("the page's data", [(m["machine"], m["alive"]) for m in machines], [("press-3", True)])
        try:
            urllib.request.urlopen(urllib.request.Request(f"{url}api/fleet", headers={"Host": "attacker.example"}), timeout=20)
            report.check("another name of this computer is refused", False)
        except urllib.error.HTTPError as error:
            report.equal("another name of this computer is refused", error.code, 403)
        # A computer that stalls fails a bus; the server brings it up again.
        state = lambda: json.load(urllib.request.urlopen(f"{url}api/fleet", timeout=20))[0]["state"]
        end = time.monotonic() + 60
        while (bus := state()["bus"]["state"]) != "op" and time.monotonic() < end:
            time.sleep(0.2)
        report.equal("the bus of the machine", bus, "op")
        if browser := shutil.which("chromium"):
            command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=3000", "--dump-dom", url]
            document = subprocess.run(command, capture_output=True, text=True, timeout=120).stdout
            report.check("a tile links to the machine's page", 'href="http://press-3:8080/"' in document, document[-2000:] if "tile" not in document else "")
            chip = re.search(r'data-state="(\w+)">([^<]*)</span></header><dl>', document)
            report.equal("it shows the state of the bus", chip and chip.groups(), ("good", "op"))


def access(report, program):
    import zenoh

    report.section("access")
    with tempfile.TemporaryDirectory(prefix="ecaxis-judge-") as temporary, contextlib.ExitStack() as stack:
        folder, port = pathlib.Path(temporary), free_port()
        authority(folder / "tls", NAMES)
        authority(folder / "other", NAMES)
        for example in (rig.ROOT / "configs/fleet").glob("*.toml"):
            text = re.sub(r'^socket *= ".*"', 'socket = "serve.sock"', example.read_text(), flags=re.M).replace("/var/lib/ecaxis-fleet/", "")
            text = text.replace("tls/router:7447", f"tls/localhost:{port}").replace("tls/[::]:7447", f"tls/127.0.0.1:{port}")
            (folder / example.name).write_text(text)
        text = (rig.ROOT / "configs/demo.toml").read_text().replace('"1ms"', '"10ms"').replace("lost_frames = 20", "lost_frames = 9")
        (folder / "machine.toml").write_text(text.replace('"esi/', f'"{rig.ROOT}/configs/esi/'))
        (folder / "forged.toml").write_text((folder / "agent.toml").read_text().replace('machine = "press-3"', 'machine = "press-4"'))
        changes, log = folder / "changes.jsonl", open(folder / "log", "wb")

        def start(*command, **environment):
            environment = {**os.environ, **environment}
            stack.enter_context(rig.process(list(map(str, command)), stdout=log, stderr=log, env=environment))

        serve = [rig.binary(), "serve", folder / "machine.toml", "--sim", "--quiet", "--socket", folder / "serve.sock"]
        start(*serve, ECAXIS_CHANGE_LOG=str(changes))
        for verb in ("router", "archive", "agent"):
            start(program, verb, folder / f"{verb}.toml")
        start(program, "agent", folder / "forged.toml")
        endpoint, tls = f"tls/localhost:{port}", folder / "tls"

        def command(*arguments):
            arguments = [program, *arguments, "--config", folder / "client.toml"]
            done = subprocess.run(arguments, capture_output=True, text=True, timeout=60)
            return json.loads(done.stdout) if done.returncode == 0 else done.stderr

        end = time.monotonic() + 20
        while time.monotonic() < end:
            rows = command("status", "--json")
            if isinstance(rows, list) and rows and rows[0]["alive"] and (rows[0]["state"] or {}).get("server") == "present":
                break
            time.sleep(0.5)
        names = [(row["machine"], row["alive"]) for row in rows] if isinstance(rows, list) else rows
        report.need("a reader sees the machine, and none under a name that is not its own", names == [("press-3", True)], names)
        report.need("and its server", rows[0]["state"]["server"] == "present", (folder / "log").read_text()[-1500:])

        reader, planner, stranger = (Client(endpoint, tls, name) for name in ("reader", "planner", "stranger"))
        leader, follower = (Client(endpoint, tls, name) for name in ("press-3", "press-4"))
        # A session hears itself: what must come to nothing comes from sessions of its own.
        forgers = [Client(endpoint, tls, name) for name in ("reader", "stranger")]
        for client in (reader, planner, stranger, leader, follower, *forgers):
            stack.callback(client.close)
        forged = '{"site":"hall-1","machine":"press-3","unix_time":9e9}'
        for client in forgers:
            token = client.session.liveliness().declare_token("ecaxis/hall-1/ghost/alive")
            answer = client.session.declare_queryable("ecaxis/*/*/state", lambda q: q.reply(f"{KEY}/state", forged))
            client.declared += [token, answer]
            for suffix in ("state", "order", "event/1", "report/1"):
                client.session.put(f"{KEY}/{suffix}", forged)
            client.session.delete(f"{KEY}/state")
        follower.declared.append(follower.session.declare_subscriber(f"{KEY}/setpoints/*", follower.hear))
        remote = zenoh.Locality.REMOTE
        publisher = leader.session.declare_publisher(f"{KEY}/setpoints/x", allowed_destination=remote)
        followed = rig.wait(lambda: publisher.matching_status.matching)
        report.check("the leader knows that it is followed", followed)
        # A congested session drops set-points, and a leader sends them again and again.
        rig.wait(lambda: publisher.put("points") or (f"{KEY}/setpoints/x", "points") in follower.heard)
        follower.session.put(f"{KEY}/setpoints/x", "forged 9e9")
        time.sleep(2)
        states = [text for key, text in reader.heard if key == f"{KEY}/state"]
        report.check("a reader hears states", len(states) >= 2, len(states))
        report.check("and asks for them", reader.ask(f"{KEY}/state"))
        report.check("a follower hears set-points", (f"{KEY}/setpoints/x", "points") in follower.heard, follower.heard[:5])
        report.equal("and nothing else", {key for key, _ in follower.heard} - {f"{KEY}/alive"}, {f"{KEY}/setpoints/x"})
        heard = [key for client in (reader, planner, stranger) for key, _ in client.heard if "setpoints" in key]
        report.equal("no one else hears them", heard, [])
        heard = [what for client in (reader, planner, leader) for what in client.heard if "9e9" in what[1] or "ghost" in what[0]]
        report.equal("no forged state, event or token arrives", heard, [])
        state = command("status", "--json")[0]["state"]
        report.check("no forged answer arrives", abs(state["unix_time"] - time.time()) < 60, state["unix_time"])
        report.equal("tokens", reader.alive(), [f"{KEY}/alive"])
        order = json.dumps({"order": json.dumps({"machine": "hall-1/press-3", "action": "start"}), "signature": ""})
        for key in (f"{KEY}/order", "ecaxis/*/*/order", ALL):
            report.equal(f"a reader's order at {key}", reader.ask(key, order), [])
        answers = [json.loads(text)["status"] for text in planner.ask(f"{KEY}/order", order)]
        report.equal("an order without a key, from a client with the right to send it, is refused", answers, ["refused"])
        wildcard = [text for text in planner.ask("ecaxis/*/*/order", order)]
        report.equal("an order to all at once has no answer", wildcard, [])
        report.equal("a stranger hears", stranger.heard, [])
        report.equal("a stranger asks for tokens", stranger.alive(), [])
        for suffix in ("state", "reports", "events", "order", "samples?signals=x.position"):
            report.equal(f"a stranger asks for {suffix}", stranger.ask(f"{KEY}/{suffix}", order), [])
        entries = [json.loads(line) for line in changes.read_text().splitlines()]
        report.equal("no command reached the machine", [entry for entry in entries if "client" in entry], [])
        page(report, program, folder)
        for what, certificates, name in (("another authority", folder / "other", "reader"), ("no certificate", tls, None)):
            try:
                client = Client(endpoint, certificates, name)
                heard = client.ask(f"{KEY}/state")
                client.close()
                report.check(f"{what}: no session", False, heard)
            except Exception as error:
                report.check(f"{what}: no session", "onnect" in str(error), str(error)[:80])
