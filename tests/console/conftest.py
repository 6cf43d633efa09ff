"""A live server and a headless Chromium for the tests of the console.

`CHROMIUM` names the browser; else it is looked for where Debian puts it. Screenshots are kept in
`SCREENSHOTS`.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, BrowserContext, Page, sync_playwright

from facades import facade
from live_server import Server, key_setting, program_under_test, serve
from placeformer import Client

SCREENSHOTS = Path(os.environ.get("SCREENSHOTS", "target/console-screenshots"))

#: Keys of the locked server.
READER, WRITER = "reader", "writer"

#: Longest wait for anything on the page, in milliseconds.
PATIENCE_MS = 60_000


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
    """A server that wants a key."""
    keys = key_setting(**{READER: "read", WRITER: "write"})
    yield from serve(program, tmp_path_factory.mktemp("locked"), PLACEFORMER_AUTH__KEYS=keys)


@pytest.fixture(scope="session")
def town(program: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small drawn town: `database`, `queries` and `positions.csv`."""
    town = tmp_path_factory.mktemp("drawn") / "town"
    command = [str(program), "synth", "--out", str(town), "--places", "4", "--views", "2"]
    subprocess.run(
        [*command, "--size", "320x240", "--conditions", "day"],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    return town


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """The browser."""
    path = os.environ.get("CHROMIUM") or shutil.which("chromium")
    if path is None:
        pytest.fail("no chromium here: apt-get install chromium, or name one in CHROMIUM")
    with sync_playwright() as playwright:
        # Its sandbox does not work for root, as whom containers run. The pages are our own.
        arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
        browser = playwright.chromium.launch(executable_path=path, args=arguments)
        yield browser
        browser.close()


@pytest.fixture
def map_name() -> str:
    """The name of a map that no other test uses."""
    return f"map-{uuid.uuid4()}"


@pytest.fixture
def client(server: Server) -> Iterator[Client]:
    """A client of the open server."""
    with Client(server.url) as client:
        yield client


def watched(context: BrowserContext, url: str, problems: list[str]) -> Page:
    """A page that notes errors, forbidden content, and requests to anyone but the server."""
    context.set_default_timeout(PATIENCE_MS)
    page = context.new_page()
    page.on("pageerror", lambda error: problems.append(f"error: {error}"))

    def note_message(text: str) -> None:
        # Chromium writes every answer that is an error to the console; the tests provoke some.
        if "Failed to load resource" not in text:
            problems.append(f"console: {text}")

    page.on(
        "console",
        lambda message: note_message(message.text) if message.type != "log" else None,
    )

    def note_request(address: str) -> None:
        if not address.startswith((url, "blob:", "data:")):
            problems.append(f"request to {address}")

    page.on("request", lambda request: note_request(request.url))
    return page


@pytest.fixture
def open_page(browser: Browser) -> Iterator[Callable[..., Page]]:
    """Opens the console of a server in a new window; whatever goes wrong there fails the test."""
    problems: list[str] = []
    contexts: list[BrowserContext] = []

    def open_page(
        server: Server,
        map_name: str | None = None,
        width: int = 1200,
        theme: str = "light",
        *,
        provokes_problems: bool = False,
    ) -> Page:
        context = browser.new_context(
            viewport={"width": width, "height": 900},
            color_scheme="dark" if theme == "dark" else "light",
        )
        contexts.append(context)
        page = watched(context, server.url, [] if provokes_problems else problems)
        page.goto(f"{server.url}/")
        if map_name is not None:
            page.locator(f"#map-choice option[value='{map_name}']").wait_for(state="attached")
            page.select_option("#map-choice", map_name)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert problems == []


def add_fronts(client: Client, map_name: str, number: int) -> None:
    """Store drawn house fronts along a street, 10 m apart, all photographed looking east."""
    for seed in range(number):
        client.add_reference(
            facade(seed),
            map_name,
            external_id=f"front-{seed}.png",
            lat=51.0,
            lon=7.0 + seed * 10 / 70_000,
            heading=90.0,
        )


def front_files(folder: Path, number: int) -> list[Path]:
    """The same house fronts as files."""
    files = []
    for seed in range(number):
        file = folder / f"front-{seed}.png"
        file.write_bytes(facade(seed))
        files.append(file)
    return files
