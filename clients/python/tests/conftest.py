"""A live server for the tests, on a loopback port of its own, and photos drawn for them.

`PLACEFORMER` names the program. Without it the tests fail, unless `PLACEFORMER_TEST_NO_SERVER=1`
asks for those that need no server.
"""

from __future__ import annotations

import hashlib
import io
import os
import random
import subprocess
import time
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest
from PIL import Image, ImageDraw

from placeformer import Client

ROOT = Path(__file__).resolve().parents[3]
WITHOUT_SERVER = os.environ.get("PLACEFORMER_TEST_NO_SERVER") == "1"
PATIENCE_SECONDS = 120.0
KEY = "a key of the tests"


@dataclass(frozen=True)
class Server:
    """A running server."""

    url: str
    program: Path


@pytest.fixture(scope="session")
def program() -> Path:
    """The program under test."""
    if WITHOUT_SERVER:
        pytest.skip("PLACEFORMER_TEST_NO_SERVER=1: no test of a live server")
    path = os.environ.get("PLACEFORMER")
    if not path:
        pytest.fail("PLACEFORMER does not name the program to test: make client-test does")
    if not os.access(path, os.X_OK):
        pytest.fail(f"PLACEFORMER={path} is no program")
    return Path(path).resolve()


def serve(program: Path, folder: Path, **settings: str) -> Iterator[Server]:
    """Run a server until the test is done with it."""
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
    try:
        assert process.stdout is not None
        line = process.stdout.readline().decode()
        assert line.startswith("listening on "), log.read_text()
        url = line.removeprefix("listening on ").strip()
        _wait_until_ready(url, log)
        yield Server(url, program)
    finally:
        process.terminate()
        process.wait(timeout=60)
        assert process.stdout is not None
        process.stdout.close()
    assert process.returncode == 0, log.read_text()


def _wait_until_ready(url: str, log: Path) -> None:
    end = time.monotonic() + PATIENCE_SECONDS
    while httpx.get(f"{url}/readyz").status_code != 200:
        assert time.monotonic() < end, log.read_text()
        time.sleep(0.05)


@pytest.fixture(scope="session")
def server(program: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server that is open to everyone."""
    yield from serve(program, tmp_path_factory.mktemp("open"))


@pytest.fixture(scope="session")
def locked_server(program: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server that wants the key `KEY`, which may only read."""
    digest = hashlib.sha256(KEY.encode()).hexdigest()
    keys = f'[{{name = "tests", sha256 = "{digest}", role = "read"}}]'
    folder = tmp_path_factory.mktemp("locked")
    yield from serve(program, folder, PLACEFORMER_AUTH__KEYS=keys)


@pytest.fixture
def client(server: Server) -> Iterator[Client]:
    """A client of the open server."""
    with Client(server.url) as client:
        yield client


@pytest.fixture
def map_name() -> str:
    """The name of a map that no other test uses."""
    return f"map-{uuid.uuid4()}"


def draw_facade(seed: int) -> Image.Image:
    """Draw a house front that no other seed gives: walls, windows, doors and signs."""
    dice = random.Random(seed)

    def colour() -> tuple[int, int, int]:
        return dice.randrange(256), dice.randrange(256), dice.randrange(256)

    image = Image.new("RGB", (320, 240), colour())
    draw = ImageDraw.Draw(image)
    for _ in range(40):
        x, y = dice.randrange(308), dice.randrange(228)
        width, height = dice.randrange(8, 70), dice.randrange(8, 60)
        draw.rectangle((x, y, x + width, y + height), fill=colour())
    return image


def png_of(image: Image.Image) -> bytes:
    """Encode as PNG."""
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    return buffer.getvalue()


def facade(seed: int) -> bytes:
    """Draw a house front, as the bytes of a PNG."""
    return png_of(draw_facade(seed))
