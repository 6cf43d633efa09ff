"""Servers, clients and photos for the tests."""

from __future__ import annotations

import io
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest
from PIL import Image

from facades import facade
from live_server import Server, key_setting, program_under_test, serve
from placeformer import Client

ROOT = Path(__file__).resolve().parents[3]
READ_KEY = "reader"


@pytest.fixture(scope="session")
def program() -> Path:
    """The program under test."""
    return program_under_test()


@pytest.fixture(scope="session")
def server(program: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server that is open to everyone."""
    yield from serve(program, tmp_path_factory.mktemp("open"))


@pytest.fixture(scope="session")
def locked_server(program: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server that wants the key `READ_KEY`, which may only read."""
    keys = key_setting(**{READ_KEY: "read"})
    yield from serve(program, tmp_path_factory.mktemp("locked"), PLACEFORMER_AUTH__KEYS=keys)


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
    """A house front that no other seed gives, as a Pillow image."""
    return Image.open(io.BytesIO(facade(seed))).convert("RGB")
