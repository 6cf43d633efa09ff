"""The composed system under test: images, containers, volumes; everything it makes it removes again."""

import json
import os
import pathlib
import shutil
import socket
import subprocess
import tempfile
import time

ROOT = pathlib.Path(__file__).resolve().parents[2]
BASE = "placeformer-base:bookworm"
PUBLIC_BASE = "debian:bookworm-slim"


def run(*command, check=True, quiet=True, env=None, timeout=900):
    """A command; its output is shown only if it fails."""
    done = subprocess.run(
        [str(part) for part in command], cwd=ROOT, env=env, text=True, timeout=timeout,
        stdout=subprocess.PIPE if quiet else None, stderr=subprocess.STDOUT if quiet else None,
    )
    if check and done.returncode != 0:
        raise RuntimeError(f"{' '.join(map(str, command))} failed ({done.returncode}):\n{done.stdout or ''}")
    return done.stdout or "" if check else done


def why_not_here():
    """Why the composed system cannot be driven on this machine, or None."""
    if not shutil.which("docker"):
        return "there is no docker client"
    if subprocess.run(["docker", "info"], capture_output=True).returncode != 0:
        return "the Docker engine does not answer"
    if compose_command() is None:
        return "there is no Docker Compose"
    if not has_image(PUBLIC_BASE) and not has_image(BASE) and os.geteuid() != 0:
        return "no base image can be pulled, and making one from Debian's packages needs root"
    return None


def compose_command():
    if subprocess.run(["docker", "compose", "version"], capture_output=True).returncode == 0:
        return ["docker", "compose"]
    return ["docker-compose"] if shutil.which("docker-compose") else None


def has_image(tag):
    if subprocess.run(["docker", "image", "inspect", tag], capture_output=True).returncode == 0:
        return True
    if tag.startswith("placeformer-"):
        return False
    try:
        return subprocess.run(["docker", "pull", "-q", tag], capture_output=True, timeout=120).returncode == 0
    except subprocess.TimeoutExpired:
        return False


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Stack:
    """One project of containers with its own name, ports and volumes."""

    def __init__(self, binary, cache):
        self.project = f"placeformer-test-{os.getpid()}"
        self.port, self.prometheus_port, self.proxy_port = free_port(), free_port(), free_port()
        self.binary = pathlib.Path(binary).resolve()
        self.scratch = pathlib.Path(tempfile.mkdtemp(prefix="placeformer-compose-"))
        self.cache = self.scratch / "cache"
        # The container's user must be able to read the model; the host's copy stays as it is.
        shutil.copytree(cache, self.cache / "placeformer")
        run("chmod", "-R", "a+rwX", self.scratch)
        self.images = {"placeformer": f"{self.project}:service"}
        self.env = None

    def build(self):
        """The service's image by the project's own Dockerfile; Prometheus and HAProxy from the public images or Debian."""
        environment = dict(os.environ, BINARY=str(self.binary))
        run("docker/build.sh", self.images["placeformer"], env=environment)
        self.images["prometheus"] = self.image_or_package("prom/prometheus:v2.53.5", "prometheus")
        self.images["haproxy"] = self.image_or_package("haproxy:2.6.12", "haproxy")
        self.env = dict(
            os.environ,
            PLACEFORMER_IMAGE=self.images["placeformer"],
            PROMETHEUS_IMAGE=self.images["prometheus"],
            HAPROXY_IMAGE=self.images["haproxy"],
            PLACEFORMER_PORT=str(self.port),
            PROMETHEUS_PORT=str(self.prometheus_port),
            PROXY_PORT=str(self.proxy_port),
            MODEL_CACHE=str(self.cache),
            # A development build on a slow machine takes seconds a query. What is tested is that
            # replicas are replaced, not how many queries they can take.
            PLACEFORMER_PIPELINE__MAX_WAIT_MS="60000",
            COMPOSE_PROJECT_NAME=self.project,
        )

    def image_or_package(self, public, package):
        if has_image(public):
            return public
        local = f"placeformer-{package}:bookworm"
        if not has_image(local):
            base = PUBLIC_BASE if has_image(PUBLIC_BASE) else BASE
            dockerfile = ROOT / "tests" / "compose" / f"{package}.Dockerfile"
            environment = dict(os.environ)
            if subprocess.run(["docker", "buildx", "version"], capture_output=True).returncode != 0:
                environment["DOCKER_BUILDKIT"] = "0"
            run("docker", "build", "-f", dockerfile, "--build-arg", f"BASE={base}", "-t", local, self.empty(), env=environment)
        return local

    def empty(self):
        folder = self.scratch / "empty"
        folder.mkdir(exist_ok=True)
        return folder

    def compose(self, *arguments, check=True):
        files = ["-f", "docker/compose.yaml", "-f", "docker/compose.replicas.yaml"]
        return run(*compose_command(), *files, *arguments, check=check, env=self.env)

    def container(self, service):
        return self.compose("ps", "-q", service).split()[-1]

    def inspect(self, service):
        return json.loads(run("docker", "inspect", self.container(service)))[0]

    def wait_healthy(self, service, seconds=120):
        """Until Docker's own health check, which is `placeformer healthcheck`, says healthy."""
        deadline = time.monotonic() + seconds
        while True:
            container = self.inspect(service)
            state = container["State"]
            health = state.get("Health", {}).get("Status")
            if health == "healthy":
                return
            if time.monotonic() > deadline or state["Status"] == "exited" or container["RestartCount"] > 2:
                raise AssertionError(f"{service} is {state['Status']}/{health} after {seconds} s:\n{self.logs(service)}")
            time.sleep(0.5)

    def logs(self, service, lines=40):
        return run("docker", "logs", "--tail", lines, self.container(service), check=False).stdout

    def volume(self, name):
        return f"{self.project}_{name}"

    def copy_volume(self, source, target):
        run("docker", "volume", "create", "--label", f"com.docker.compose.project={self.project}", self.volume(target))
        run(
            "docker", "run", "--rm", "--user", "0", "--entrypoint", "cp",
            "-v", f"{self.volume(source)}:/from:ro", "-v", f"{self.volume(target)}:/to",
            self.images["placeformer"], "-a", "/from/.", "/to/",
        )

    def remove(self):
        if self.env:
            self.compose("down", "--volumes", "--remove-orphans", "--timeout", "5", check=False)
            leftover = run("docker", "volume", "ls", "-q", "--filter", f"name={self.project}_", check=False).stdout.split()
            if leftover:
                run("docker", "volume", "rm", "-f", *leftover, check=False)
            run("docker", "image", "rm", "-f", self.images["placeformer"], check=False)
        shutil.rmtree(self.scratch, ignore_errors=True)
