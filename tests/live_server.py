"""A live server for tests in Python, on a loopback port of its own.

The variable `PLACEFORMER` names the program. Without it the tests fail, unless
`PLACEFORMER_TEST_NO_SERVER=1` asks for those that need no server.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

PATIENCE_SECONDS = 120.0


@dataclass(frozen=True)
class Server:
    """A running server."""

    url: str
    program: Path


def program_under_test() -> Path:
    """The program that the tests are about."""
    if os.environ.get("PLACEFORMER_TEST_NO_SERVER") == "1":
        pytest.skip("PLACEFORMER_TEST_NO_SERVER=1: no test of a live server")
    path = os.environ.get("PLACEFORMER")
    if not path:
        pytest.fail("PLACEFORMER does not name the program to test")
    if not os.access(path, os.X_OK):
        pytest.fail(f"PLACEFORMER={path} is no program")
    return Path(path).resolve()


def key_setting(**roles: str) -> str:
    """The setting `auth.keys` for keys that are named like what they allow: `Writer="write"`."""
    rows = []
    for key, role in roles.items():
        digest = hashlib.sha256(key.encode()).hexdigest()
        rows.append(f'{{name = "{key}", sha256 = "{digest}", role = "{role}"}}')
    return f"[{', '.join(rows)}]"


def serve(program: Path, folder: Path, **settings: str) -> Iterator[Server]:
    """Run a server until the test is done with it; it has to end as it should."""
    settings = {
        # A photo may take long on a busy machine, which is not what is tested here.
        "PLACEFORMER_PIPELINE__DEADLINE_MS": "120000",
        "PLACEFORMER_PIPELINE__MAX_WAIT_MS": "60000",
        **settings,
    }
    data = str(folder / "data")
    command = [str(program), "serve", "--listen", "127.0.0.1:0", "--data", data]
    log = folder / "log"
    with log.open("wb") as log_file:
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=log_file, env=os.environ | settings
        )
    assert process.stdout is not None
    try:
        line = process.stdout.readline().decode()
        assert line.startswith("listening on "), log.read_text()
        url = line.removeprefix("listening on ").strip()
        _wait_until_ready(url, log)
        yield Server(url, program)
    finally:
        process.terminate()
        process.wait(timeout=60)
        process.stdout.close()
    assert process.returncode == 0, log.read_text()


def _wait_until_ready(url: str, log: Path) -> None:
    end = time.monotonic() + PATIENCE_SECONDS
    while True:
        try:
            with urllib.request.urlopen(f"{url}/readyz", timeout=10):
                return
        except urllib.error.HTTPError as answer:
            answer.close()
        assert time.monotonic() < end, log.read_text()
        time.sleep(0.05)
