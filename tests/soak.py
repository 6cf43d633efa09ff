#!/usr/bin/env python3
"""An hour with clients that misbehave: does an honest one notice?

A server runs on loopback with a drawn town. First one honest client asks a query a second, alone. Then it goes on
beside a fleet that offers 1.2 times what the server can answer, and beside ten clients that each misbehave in their
own way (soak_clients.py). The run fails if the honest client got anything but answers, or if its 99th percentile is
more than twice what it was alone.

    tests/soak.py --binary target/release/placeformer --seconds 3600

Only the standard library is used. Every client has a key and a loopback address of its own. Those who load the server
and those who misbehave are processes of a lower priority, because in life they have computers of their own.
"""

import argparse
import hashlib
import http.client
import json
import multiprocessing
import os
import pathlib
import secrets
import signal
import subprocess
import sys
import tempfile
import threading
import time

import soak_clients

HONEST, FLEET = "127.0.0.2", "127.0.0.1"
# Seconds in which the fleet measures what the server can answer.
CAPACITY_SECONDS = 15
SAMPLE_SECONDS = 5
# What `nice` adds for processes that stand for other computers.
LOWER_PRIORITY = 10


def percentile(values, share):
    """The smallest value that so large a share does not exceed."""
    ordered = sorted(values)
    return ordered[max(0, -(-len(ordered) * share // 100) - 1)] if ordered else float("nan")


class Server:
    """The program under test, with its data in a temporary folder."""

    def __init__(self, binary, folder, keys):
        self.binary, self.folder = binary, folder
        settings = folder / "placeformer.toml"
        lines = ["[http]", 'listen = "127.0.0.1:0"']
        for name, key in keys.items():
            role = "write" if name == "builder" else "read"
            digest = hashlib.sha256(key.encode()).hexdigest()
            lines += ["[[auth.keys]]", f'name = "{name}"', f'sha256 = "{digest}"', f'role = "{role}"']
        settings.write_text("\n".join(lines) + "\n")
        command = [binary, "serve", "--config", settings, "--data", folder / "data"]
        self.log = open(folder / "server.log", "wb")
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=self.log)
        first = self.process.stdout.readline().decode().strip()
        if not first.startswith("listening on "):
            raise SystemExit(f"the server did not start; see {folder / 'server.log'}")
        self.url = first.removeprefix("listening on ")
        self.port = int(self.url.rsplit(":", 1)[1])

    def wait_until_ready(self):
        while self.run(["healthcheck", "--server", self.url], check=False).returncode:
            if self.process.poll() is not None:
                raise SystemExit("the server ended while it started")
            time.sleep(0.2)

    def run(self, arguments, key=None, check=True):
        environment = dict(os.environ)
        environment.pop("PLACEFORMER_CONFIG", None)
        if key:
            environment["PLACEFORMER_API_KEY"] = key
        command = [self.binary, *arguments]
        return subprocess.run(command, check=check, env=environment, capture_output=True, text=True)

    def resident_mib(self):
        with open(f"/proc/{self.process.pid}/statm") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / (1 << 20)

    def open_files(self):
        return len(os.listdir(f"/proc/{self.process.pid}/fd"))

    def stop(self):
        """Asks it to stop; returns how it ended."""
        self.process.send_signal(signal.SIGTERM)
        try:
            return self.process.wait(timeout=90)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            return "not at all"


class Honest:
    """One query a second, whether or not the last one was answered; each counts from when it was due."""

    def __init__(self, target, key):
        self.target, self.key = target, key
        self.lock = threading.Lock()
        self.answered, self.stages, self.errors = [], [], []

    def ask(self, due, photo):
        try:
            status, body = self.target.request(HONEST, "POST", self.target.query, self.key, photo)
            error = None if status == 200 else f"{status} {body[:200]!r}"
            stages = json.loads(body)["timings_ms"] if status == 200 else {}
        except (OSError, http.client.HTTPException) as failure:
            error = repr(failure)
        took = time.monotonic() - due
        with self.lock:
            if error is None:
                self.answered.append(took * 1000)
                self.stages.append(stages)
            else:
                self.errors.append(error)

    def run(self, seconds, meanwhile=lambda: None):
        """Asks for so long; returns the latencies in milliseconds, and the errors."""
        self.answered, self.stages, self.errors = [], [], []
        began, threads = time.monotonic(), []
        for number in range(max(1, int(seconds))):
            due = began + number
            while (wait := due - time.monotonic()) > 0:
                meanwhile()
                time.sleep(min(wait, 0.25))
            photo = self.target.photos[number % len(self.target.photos)]
            thread = threading.Thread(target=self.ask, args=(due, photo))
            thread.start()
            threads.append(thread)
        for thread in threads:
            thread.join()
        return self.answered, self.errors

    def stages_in_words(self):
        """The median and the 99th percentile of each stage that the answers tell, in words."""
        names = sorted({name for stages in self.stages for name in stages})
        values = {name: [stages.get(name, 0.0) for stages in self.stages] for name in names}
        shown = [(name, percentile(values[name], 50), percentile(values[name], 99)) for name in names]
        return ", ".join(f"{name} {median:.0f}/{slow:.0f}" for name, median, slow in shown)


class Watch:
    """Resident memory and open files over time."""

    def __init__(self, server):
        self.server, self.samples, self.next = server, [], 0.0
        self.began = time.monotonic()

    def __call__(self):
        now = time.monotonic()
        if now >= self.next and self.server.process.poll() is None:
            self.next = now + SAMPLE_SECONDS
            self.samples.append((now - self.began, self.server.resident_mib(), self.server.open_files()))

    def lines(self, count=20):
        step = max(1, len(self.samples) // count)
        for at, memory, files in self.samples[::step]:
            yield f"  {at:7.0f} s  {memory:8.0f} MiB  {files:6d} open files"


def quantiles(latencies):
    return f"p50 {percentile(latencies, 50):.0f} ms, p99 {percentile(latencies, 99):.0f} ms of {len(latencies)}"


def fleet(server, arguments, key):
    """Starts the open loop at 1.2 times the capacity; its report goes to a file."""
    command = [server.binary, "load", "--server", server.url, "--map", "town"]
    command += ["--images", server.folder / "town" / "queries", "--times-capacity", str(arguments.times_capacity)]
    command += ["--capacity-seconds", str(CAPACITY_SECONDS), "--duration", str(arguments.seconds)]
    command += ["--json", server.folder / "load.json"]
    environment = dict(os.environ, PLACEFORMER_API_KEY=key)
    output = open(server.folder / "load.log", "wb")
    lower = ["nice", "-n", str(LOWER_PRIORITY)]
    return subprocess.Popen(lower + command, env=environment, stdout=output, stderr=output)


def misbehave(target, keys, stopped, outcomes):
    """In a process of its own: runs the clients that misbehave until they are stopped."""
    os.nice(LOWER_PRIORITY)
    soak_clients.arm()
    clients = []
    for number, kind in enumerate(soak_clients.KINDS):
        clients.append(kind(target, f"127.0.0.{10 + number}", keys[kind.__name__]))
    for client in clients:
        client.start()
    stopped.wait()
    for client in clients:
        client.stopped.set()
    outcomes.put({client.name: client.outcomes for client in clients})


def soak(server, arguments, keys):
    """Both phases; returns what went wrong, in words."""
    photos = [path.read_bytes() for path in sorted((server.folder / "town" / "queries").glob("*.jpg"))]
    target = soak_clients.Target(server.port, "town", photos)
    honest = Honest(target, keys["honest"])
    honest.run(5)
    quiet, errors = honest.run(arguments.quiet_seconds)
    print(f"alone:        {quantiles(quiet)} ({honest.stages_in_words()})", flush=True)
    problems = [f"an error while it was alone: {error}" for error in errors[:3]]

    load = fleet(server, arguments, keys["fleet"])
    time.sleep(CAPACITY_SECONDS + 1)
    stopped, outcomes = multiprocessing.Event(), multiprocessing.Queue()
    clients = multiprocessing.Process(
        target=misbehave, args=(target, keys, stopped, outcomes), daemon=True
    )
    clients.start()
    watch = Watch(server)
    loud, errors = honest.run(arguments.seconds - 2, watch)
    stopped.set()
    load.wait()
    print(f"beside them:  {quantiles(loud)} ({honest.stages_in_words()})")
    print(f"ratio of p99: {percentile(loud, 99) / percentile(quiet, 99):.2f} (at most {arguments.max_ratio})")
    report(server, outcomes.get(), watch)
    problems += [f"{len(errors)} errors of the honest client, such as {error}" for error in errors[:1]]
    if fleet_report(server).get("rejected_without_retry_after", 0):
        problems.append("the fleet was refused without Retry-After")
    if not loud or percentile(loud, 99) > arguments.max_ratio * percentile(quiet, 99):
        problems.append("the 99th percentile of the honest client is above the bar")
    return problems


def fleet_report(server):
    result = server.folder / "load.json"
    return json.loads(result.read_text()) if result.exists() else {}


def report(server, outcomes, watch):
    print("the fleet:")
    if numbers := fleet_report(server):
        shown = ["capacity", "rate", "admitted", "rejected", "rejected_without_retry_after", "failed", "not_sent"]
        print("  " + ", ".join(f"{name} {numbers.get(name)}" for name in shown))
    else:
        print("  " + (server.folder / "load.log").read_text().strip())
    print("those who misbehave:")
    for name, counts in outcomes.items():
        told = ", ".join(f"{what}: {count}" for what, count in counts.most_common())
        print(f"  {name:16} {told}")
    print("the server:")
    print("\n".join(watch.lines()))


def parse():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--binary", required=True, type=pathlib.Path)
    parser.add_argument("--seconds", type=int, default=3600, help="of the loud phase")
    parser.add_argument("--quiet-seconds", type=int, help="of the quiet one; a tenth, at least 60, unless given")
    parser.add_argument("--times-capacity", type=float, default=1.2)
    parser.add_argument("--max-ratio", type=float, default=2.0)
    arguments = parser.parse_args()
    arguments.binary = arguments.binary.resolve()
    if arguments.quiet_seconds is None:
        arguments.quiet_seconds = max(60, arguments.seconds // 10)
    return arguments


def main():
    arguments = parse()
    names = ["builder", "honest", "fleet"] + [kind.__name__ for kind in soak_clients.KINDS]
    keys = {name: secrets.token_hex(32) for name in names}
    with tempfile.TemporaryDirectory(prefix="placeformer-soak-") as name:
        folder = pathlib.Path(name)
        server = Server(arguments.binary, folder, keys)
        try:
            server.wait_until_ready()
            town = folder / "town"
            server.run(["synth", "--out", town, "--places", "20", "--views", "2"])
            server.run(["import", town / "database", "--map", "town", "--server", server.url], keys["builder"])
            problems = soak(server, arguments, keys)
        finally:
            ended = server.stop()
        if ended != 0:
            problems.append(f"the server ended with {ended} when it was asked to stop")
        log = (folder / "server.log").read_text(errors="replace")
        problems += [f"the log says: {line}" for line in log.splitlines() if "panicked" in line][:3]
    for problem in problems:
        print(f"FAILED: {problem}")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
