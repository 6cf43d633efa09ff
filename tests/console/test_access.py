"""For everyone: with the keyboard alone, in both themes, on a phone, and as axe-core checks it."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import axe_playwright_python
import pytest
from playwright.sync_api import Page, expect

from conftest import SCREENSHOTS, add_fronts, front_files
from live_server import Server
from placeformer import Client

OpenPage = Callable[..., Page]

AXE = (Path(axe_playwright_python.__file__).parent / "axe.min.js").read_text()

#: Presses of the tabulator key after which a person has given up.
MOST_STEPS = 60


def tab_to(page: Page, selector: str) -> None:
    """Press the tabulator key until an element has the focus."""
    for _ in range(MOST_STEPS):
        if page.evaluate("(one) => document.activeElement.matches(one)", selector):
            return
        page.keyboard.press("Tab")
    pytest.fail(f"{selector} cannot be reached with the tabulator key")


def test_everything_works_with_the_keyboard_alone(
    server: Server, client: Client, map_name: str, open_page: OpenPage, tmp_path: Path
) -> None:
    add_fronts(client, map_name, 4)
    page = open_page(server, map_name)
    page.reload()
    expect(page.locator("#map-choice")).to_have_value(map_name)
    page.keyboard.press("Tab")
    expect(page.locator(".skip")).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.locator("#main")).to_be_focused()
    tab_to(page, "#locate-files")
    with page.expect_file_chooser() as chooser:
        page.keyboard.press("Space")
    chooser.value.set_files([str(file) for file in front_files(tmp_path, 4)[2:]])
    expect(page.locator("#pair")).to_be_visible()
    tab_to(page, ".ranks li:nth-child(2) button")
    page.keyboard.press("Enter")
    expect(page.locator("#evidence h2")).to_have_text("Why place 2")
    tab_to(page, "#evidence input[type=checkbox]")
    page.keyboard.press("Space")
    expect(page.get_by_label("pairs that agree")).not_to_be_checked()
    tab_to(page, "#evidence .toolbar button")
    page.keyboard.press("Enter")
    expect(page.locator("#map-canvas")).to_be_focused()
    expect(page.locator("#reference")).to_contain_text("front-")

    # The map: moved to its eastern end, so that Enter means the last reference.
    for key in ["+", "ArrowRight", "ArrowUp", "ArrowLeft", "ArrowDown", "-"]:
        page.keyboard.press(key)
    for _ in range(60):
        page.keyboard.press("ArrowRight")
    page.keyboard.press("Enter")
    expect(page.locator("#reference")).to_contain_text("front-3.png")

    # From tab to tab with the arrows, and round to the first.
    page.keyboard.press("Control+Home")
    page.evaluate("document.activeElement.blur()")
    tab_to(page, "#tab-map")
    for name in ["add", "server", "locate"]:
        page.keyboard.press("ArrowRight")
        expect(page.locator(f"#tab-{name}")).to_be_focused()
        expect(page.locator(f"#{name}")).to_be_visible()
    tab_to(page, "#key-button")
    page.keyboard.press("Enter")
    expect(page.locator("#key")).to_be_focused()
    page.keyboard.press("Escape")
    expect(page.get_by_role("dialog")).to_be_hidden()
    expect(page.locator("#key-button")).to_be_focused()


def test_the_theme_follows_the_system_or_the_button(server: Server, open_page: OpenPage) -> None:
    def ground(page: Page) -> str:
        colour: str = page.evaluate("getComputedStyle(document.body).backgroundColor")
        return colour

    light, dark = open_page(server, theme="light"), open_page(server, theme="dark")
    assert ground(light) != ground(dark)
    button = dark.locator("#theme-button")
    button.click()
    expect(button).to_have_text("Theme: light")
    assert ground(dark) == ground(light)
    button.click()
    expect(button).to_have_text("Theme: dark")
    dark.reload()
    expect(button).to_have_text("Theme: dark")


def checked(page: Page, name: str) -> None:
    """Check with axe-core, and that nothing runs off the edge; keep a screenshot."""
    page.evaluate(AXE)
    found: dict[str, Any] = page.evaluate(
        "axe.run(document, {resultTypes: ['violations', 'incomplete']})"
    )
    violations = [
        f"{one['id']}: {one['help']}: {[node['html'][:120] for node in one['nodes']]}"
        for one in found["violations"]
    ]
    assert violations == [], name
    assert len(found["passes"]) > 15
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), name
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=SCREENSHOTS / f"{name}.png", full_page=True)


@pytest.fixture(scope="session")
def town_map(server: Server, town: Path) -> str:
    """The drawn town as a map."""
    map_name = "town"
    with Client(server.url) as client:
        for file in sorted((town / "database").iterdir()):
            fields = re.match(r"@.*@U@([\d.]+)@([\d.]+)@p\w+@@([\d.]+)@", file.name)
            assert fields is not None, file.name
            lat, lon, heading = (float(text) for text in fields.groups())
            client.add_reference(
                file, map_name, external_id=file.name, lat=lat, lon=lon, heading=heading
            )
    return map_name


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("width", [1200, 400])
def test_every_tab_passes_axe_and_is_pictured(
    server: Server, town_map: str, town: Path, open_page: OpenPage, theme: str, width: int
) -> None:
    page = open_page(server, town_map, width=width, theme=theme)
    suffix = f"{theme}-{width}"
    checked(page, f"empty-{suffix}")
    photos = [str(file) for file in sorted((town / "database").iterdir())]
    page.locator("#pictures summary").click()
    page.set_input_files("#picture-files", photos)
    page.locator("#locate-options summary").click()
    queries = [str(file) for file in sorted((town / "queries").iterdir())]
    page.set_input_files("#locate-files", queries[:2])
    expect(page.locator("#pair")).to_be_visible()
    expect(page.locator("#frames small").last).not_to_have_text("waiting")
    checked(page, f"locate-{suffix}")
    page.get_by_role("button", name="Show on the map").click()
    expect(page.locator("#reference dl")).to_be_visible()
    checked(page, f"map-{suffix}")
    page.click("#tab-add")
    page.set_input_files("#add-files", [*photos[:2], str(Path(__file__))])
    expect(page.locator("#add-state")).to_contain_text("Done: ")
    checked(page, f"add-{suffix}")
    page.click("#tab-server")
    expect(page.locator("#stages tr").first).to_be_visible()
    checked(page, f"server-{suffix}")
    page.click("#key-button")
    expect(page.get_by_role("dialog")).to_be_visible()
    checked(page, f"key-{suffix}")
