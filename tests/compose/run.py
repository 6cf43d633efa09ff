#!/usr/bin/env python3
"""Drives the composed system end to end, as an operator would.

It ingests and queries, reads the metrics back through the real Prometheus, kills a container in the
middle of ingest and checks that nothing is lost, restarts the service without a failure for a client
that retries, and replaces replicas one after the other without a failed query. Where there is no
Docker engine it is skipped and says why.
"""

import argparse
import os
import pathlib
import sys
import threading
import time
import traceback

HERE = pathlib.Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]
import client
from facades import facade
from stack import Stack, run, why_not_here

MAP = "compose"
IMAGES = 16


def check(truth, message):
    if not truth:
        raise AssertionError(message)


class Checks:
    """The checks in the order of an operator's day; each stands on what the ones before left."""

    def __init__(self, stack):
        self.stack = stack
        self.pictures = {f"front-{seed:03}": facade(seed) for seed in range(IMAGES)}
        self.acknowledged = {}

    def starts_healthy_and_confined(self):
        self.stack.compose("up", "-d", "placeformer", "prometheus")
        self.stack.wait_healthy("placeformer")
        state = self.stack.inspect("placeformer")
        check(state["HostConfig"]["ReadonlyRootfs"], "the root file system is writable")
        container = self.stack.container("placeformer")
        check(run("docker", "exec", container, "id", "-u").strip() == "10001", "the service does not run as its own user")
        written = run("docker", "exec", container, "touch", "/usr/local/bin/x", check=False)
        check(written.returncode != 0, "a file could be written next to the binary")
        processes = run("docker", "exec", container, "cat", "/proc/1/comm").strip()
        check(processes == "placeformer", f"process 1 is {processes}")

    def ingests_and_answers(self):
        for name, image in self.pictures.items():
            status, reference = client.ingest(self.stack.port, MAP, name, image)
            check(status == 201, f"{name}: {status} instead of 201")
            self.acknowledged[name] = reference["id"]
        again, reference = client.ingest(self.stack.port, MAP, "front-000", self.pictures["front-000"])
        check(again == 200 and reference["id"] == self.acknowledged["front-000"], "the same image became another reference")
        self.answers_are_right(self.stack.port, self.pictures)

    def answers_are_right(self, port, pictures):
        for name, image in pictures.items():
            answer = client.query(port, MAP, image, top_k=3)
            best = answer["results"][0]
            check(answer["reranked"], f"{name} was not re-ranked")
            check(best["external_id"] == name, f"{name} was taken for {best['external_id']}")

    def prometheus_tells_the_same(self):
        wanted = [
            ('up{job="placeformer"}', 1),
            (f'placeformer_references{{map="{MAP}"}}', IMAGES),
            ('sum(placeformer_http_requests_total{route="/references",method="POST",status="201"})', IMAGES),
            ('sum(placeformer_http_requests_total{route="/query",status="200"})', IMAGES),
            ('placeformer_stage_duration_seconds_count{stage="rerank"}', IMAGES),
            ('placeformer_stage_duration_seconds_count{stage="commit"} >= bool 16', 1),
            ('placeformer_memory_bytes{component="model"} > bool 1e6', 1),
            ('sum(placeformer_http_requests_total{status=~"5.."}) or vector(0)', 0),
        ]
        deadline = time.monotonic() + 60
        for expression, value in wanted:
            while (found := self.ask_prometheus(expression)) != value:
                check(time.monotonic() < deadline, f"{expression} is {found}, not {value}")
                time.sleep(1)

    def ask_prometheus(self, expression):
        try:
            status, _, content = client.request(self.stack.prometheus_port, "GET", "/api/v1/query", {"query": expression})
        except OSError:
            return "no answer"
        if status != 200 or not content["data"]["result"]:
            return f"nothing ({status})"
        return float(content["data"]["result"][0]["value"][1])

    def alert_rules_are_evaluated(self):
        deadline = time.monotonic() + 60
        while True:
            _, _, content = client.request(self.stack.prometheus_port, "GET", "/api/v1/rules")
            rules = [rule for group in content["data"]["groups"] for rule in group["rules"]]
            if rules and all(rule["health"] == "ok" for rule in rules):
                break
            check(time.monotonic() < deadline, f"rules: {[(r['name'], r['health'], r.get('lastError')) for r in rules]}")
            time.sleep(1)
        check(len(rules) >= 10, f"only {len(rules)} rules were loaded")
        firing = [rule["name"] for rule in rules if rule["state"] == "firing"]
        check(not firing, f"a healthy system fires {firing}")

    def killed_during_ingest_loses_nothing(self):
        """Three clients ingest while the container is killed; what was acknowledged must be there afterwards."""
        lock, stop = threading.Lock(), threading.Event()

        def feed(first):
            for seed in range(first, first + 1000, 3):
                if stop.is_set():
                    return
                try:
                    _, reference = client.ingest(self.stack.port, MAP, f"front-{seed:03}", facade(seed))
                except (OSError, client.Refused, client.http.client.HTTPException):
                    return
                with lock:
                    self.acknowledged[f"front-{seed:03}"] = reference["id"]

        feeders = [threading.Thread(target=feed, args=(1000 + n,)) for n in range(3)]
        for feeder in feeders:
            feeder.start()
        before = len(self.acknowledged)
        deadline = time.monotonic() + 120
        while len(self.acknowledged) < before + 6 and time.monotonic() < deadline:
            time.sleep(0.02)
        run("docker", "kill", "--signal", "KILL", self.stack.container("placeformer"))
        stop.set()
        for feeder in feeders:
            feeder.join()
        check(len(self.acknowledged) >= before + 6, "too little was ingested before the kill")
        self.stack.compose("up", "-d", "placeformer")
        self.stack.wait_healthy("placeformer")
        self.everything_is_there(self.stack.port)
        self.answers_are_right(self.stack.port, dict(list(self.pictures.items())[:4]))

    def everything_is_there(self, port):
        stored = {reference["external_id"]: reference["id"] for reference in client.references(port, MAP)}
        lost = {name: id_ for name, id_ in self.acknowledged.items() if stored.get(name) != id_}
        check(not lost, f"{len(lost)} of {len(self.acknowledged)} acknowledged references are lost: {sorted(lost)[:5]}")
        # A write whose answer was cut off may be stored or not: it was not acknowledged.
        check(len(stored) <= len(self.acknowledged) + 3, f"{len(stored)} references from {len(self.acknowledged)} answers")

    def a_restart_is_a_pause_for_a_patient_client(self):
        outcomes, stop = [], threading.Event()

        def patient():
            while not stop.is_set():
                image = self.pictures["front-003"]
                status, content, _ = client.with_retries(
                    lambda: client.post_image(self.stack.port, "/query", image, map=MAP, top_k=1)
                )
                outcomes.append((status, content["results"][0]["external_id"] if status == 200 else content))

        thread = threading.Thread(target=self.guarded(patient, outcomes))
        thread.start()
        time.sleep(1)
        container = self.stack.container("placeformer")
        began = time.monotonic()
        self.stack.compose("stop", "placeformer")
        took = time.monotonic() - began
        code = self.stack_exit_code(container)
        self.stack.compose("up", "-d", "placeformer")
        self.stack.wait_healthy("placeformer")
        time.sleep(1)
        stop.set()
        thread.join()
        check(code == 0, f"the service left with {code} when asked to stop")
        check(took < 35, f"stopping took {took:.0f} s: Docker had to kill it")
        wrong = [outcome for outcome in outcomes if outcome != (200, "front-003")]
        check(outcomes and not wrong, f"{len(wrong)} of {len(outcomes)} queries failed: {wrong[:3]}")

    @staticmethod
    def guarded(call, outcomes):
        """A failure in a thread becomes an outcome, so that it cannot be missed."""

        def wrapped():
            try:
                call()
            except BaseException as error:  # noqa: B902 - it is reported by the check
                outcomes.append(("failed", repr(error)))

        return wrapped

    @staticmethod
    def stack_exit_code(container):
        return int(run("docker", "inspect", "--format", "{{.State.ExitCode}}", container).strip())

    def replicas_are_replaced_without_a_failed_query(self):
        """Two replicas on copies of the data behind HAProxy; each is replaced by a new container under steady load."""
        self.stack.compose("stop", "placeformer")
        for replica in ("replica-a", "replica-b"):
            self.stack.copy_volume("data", replica)
        self.stack.compose("up", "-d", "placeformer", "replica-a", "replica-b", "proxy")
        for service in ("placeformer", "replica-a", "replica-b"):
            self.stack.wait_healthy(service)
        self.wait_for_proxy()
        outcomes, stop = [], threading.Event()

        def drive(offset):
            names = list(self.pictures)
            turn = offset
            while not stop.is_set():
                name = names[turn % len(names)]
                turn += 1
                try:
                    answer = client.query(self.stack.proxy_port, MAP, self.pictures[name], top_k=1, candidates=10)
                    outcomes.append(answer["results"][0]["external_id"] == name or f"{name} was taken for another")
                except (OSError, client.Refused, client.http.client.HTTPException) as error:
                    outcomes.append(f"{time.strftime('%X')} {error!r}")

        drivers = [threading.Thread(target=self.guarded(lambda n=n: drive(n), outcomes)) for n in (0, 11)]
        for driver in drivers:
            driver.start()
        replaced = []
        for replica in ("replica-a", "replica-b"):
            old, answered = self.stack.container(replica), len(outcomes)
            self.stack.compose("up", "-d", "--no-deps", "--force-recreate", replica)
            self.stack.wait_healthy(replica)
            time.sleep(3)
            replaced.append((self.stack.container(replica) != old, len(outcomes) - answered))
        stop.set()
        for driver in drivers:
            driver.join()
        failed = [outcome for outcome in outcomes if outcome is not True]
        check(not failed, f"{len(failed)} of {len(outcomes)} queries failed: {failed[:3]}")
        check(all(new and answered > 0 for new, answered in replaced), f"replaced, queries meanwhile: {replaced}")
        print(f"    {len(outcomes)} queries answered during two replacements, none failed")
        self.everything_is_there(self.stack.proxy_port)

    def wait_for_proxy(self):
        deadline = time.monotonic() + 30
        while True:
            try:
                client.query(self.stack.proxy_port, MAP, self.pictures["front-000"], top_k=1)
                return
            except (OSError, client.Refused, client.http.client.HTTPException) as error:
                check(time.monotonic() < deadline, f"the proxy does not answer: {error!r}")
                time.sleep(0.5)

    def the_store_verifies(self):
        self.stack.compose("stop", "placeformer")
        report = run(
            "docker", "run", "--rm", "--read-only", "-v", f"{self.stack.volume('data')}:/data",
            self.stack.images["placeformer"], "verify", "--data", "/data", check=False,
        )
        check(report.returncode == 0, f"verify found damage:\n{report.stdout}")


STEPS = [
    Checks.starts_healthy_and_confined,
    Checks.ingests_and_answers,
    Checks.prometheus_tells_the_same,
    Checks.alert_rules_are_evaluated,
    Checks.killed_during_ingest_loses_nothing,
    Checks.a_restart_is_a_pause_for_a_patient_client,
    Checks.replicas_are_replaced_without_a_failed_query,
    Checks.the_store_verifies,
]


def model_cache():
    base = os.environ.get("PLACEFORMER_CACHE")
    if base:
        return pathlib.Path(base)
    return pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache") / "placeformer"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--binary", required=True, help="the placeformer binary to put into the image")
    parser.add_argument("--cache", type=pathlib.Path, default=model_cache(), help="the host's model cache")
    arguments = parser.parse_args()
    if reason := why_not_here():
        print(f"SKIPPED: {reason}")
        return 0
    stack = Stack(arguments.binary, arguments.cache)
    passed = 0
    try:
        began = time.monotonic()
        stack.build()
        print(f"  images built ({time.monotonic() - began:.0f} s)", flush=True)
        checks = Checks(stack)
        for step in STEPS:
            began = time.monotonic()
            step(checks)
            passed += 1
            print(f"  ok {step.__name__} ({time.monotonic() - began:.1f} s)", flush=True)
    except BaseException:
        traceback.print_exc()
        if stack.env:
            print(stack.compose("logs", "--tail", "40", check=False).stdout, file=sys.stderr)
        print(f"{passed} passed, 1 failed")
        return 1
    finally:
        stack.remove()
    print(f"{passed} passed, 0 failed")
    return 0


if __name__ == "__main__":
    sys.exit(main())
