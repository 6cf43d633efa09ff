"""Photos are added to a map by dropping them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from playwright.sync_api import Page, Route, expect

from conftest import READER, WRITER, add_fronts, front_files
from facades import facade
from live_server import Server
from placeformer import Client
from test_locate import drop

OpenPage = Callable[..., Page]


def test_photos_get_a_verdict_each_and_positions_from_a_table(
    server: Server, client: Client, map_name: str, open_page: OpenPage, tmp_path: Path
) -> None:
    table = tmp_path / "positions.csv"
    table.write_text('file,lat,lon,heading\r\n"some, where/front-0.png",51.5,7.25,90\r\n')
    broken = tmp_path / "broken.png"
    broken.write_bytes(facade(9)[:300])
    files = [*front_files(tmp_path, 3), broken, table]
    page = open_page(server)
    page.click("#tab-add")
    page.fill("#add-map", map_name)
    page.set_input_files("#add-files", [str(file) for file in files])
    state = page.locator("#add-state")
    expect(state).to_have_text("Done: 3 added, 0 already there, 1 refused.")
    rows = page.locator("#verdicts tr")
    expect(rows).to_have_count(4)
    # What somebody has to look at comes first.
    expect(rows.first).to_contain_text("broken.png")
    expect(rows.first).to_contain_text("The image cannot be decoded")
    expect(page.locator("#verdicts tr", has_text="front-0.png")).to_contain_text("request")
    (placed,) = client.references(map_name, external_id="front-0.png")
    assert placed.location is not None
    assert (placed.location.lat, placed.location.heading) == (51.5, 90.0)
    # It is the chosen map now, and its photos are known here.
    expect(page.locator("#map-choice")).to_have_value(map_name)
    page.set_input_files("#add-files", [str(file) for file in files[:3]])
    expect(state).to_have_text("Done: 0 added, 3 already there, 0 refused.")
    page.click("#tab-locate")
    drop(page, "#locate-drop", [("frame.png", facade(1))])
    expect(page.locator("figcaption")).to_have_text("First your photo, then the place.")
    assert client.map(map_name).references == 3


def test_it_can_be_stopped_and_goes_on_where_it_was(
    server: Server, client: Client, map_name: str, open_page: OpenPage, tmp_path: Path
) -> None:
    files = [str(file) for file in front_files(tmp_path, 8)]
    page = open_page(server)
    held: list[Route] = []
    pattern = "**/references?*"
    page.route(pattern, lambda route: held.append(route) if len(held) < 3 else route.abort())
    page.click("#tab-add")
    page.fill("#add-map", map_name)
    page.set_input_files("#add-files", files)
    expect(page.locator("#stop-adding")).to_be_enabled()
    page.click("#stop-adding")
    state = page.locator("#add-state")
    expect(state).to_have_text("Stopped with 8 photos left: 0 added, 0 already there, 0 refused.")
    for route in held:
        route.abort()
    page.unroute(pattern)
    page.set_input_files("#add-files", files)
    expect(state).to_have_text("Done: 8 added, 0 already there, 0 refused.")
    assert client.map(map_name).references == 8


@pytest.mark.parametrize("name", ["", "no spaces", "-first"])
def test_a_map_needs_a_name(
    server: Server,
    client: Client,
    map_name: str,
    open_page: OpenPage,
    tmp_path: Path,
    name: str,
) -> None:
    add_fronts(client, map_name, 1)
    page = open_page(server, map_name)
    page.click("#tab-add")
    # The chosen map is offered, until somebody writes another name.
    expect(page.locator("#add-map")).to_have_value(map_name)
    page.fill("#add-map", name)
    page.set_input_files("#add-files", str(front_files(tmp_path, 1)[0]))
    expect(page.locator("#add-state")).to_contain_text("Name the map first")
    expect(page.locator("#add-map")).to_be_focused()


def test_a_table_without_names_is_refused(
    server: Server, map_name: str, open_page: OpenPage, tmp_path: Path
) -> None:
    table = tmp_path / "positions.csv"
    table.write_text("lat,lon\n1,2\n")
    page = open_page(server)
    page.click("#tab-add")
    page.fill("#add-map", map_name)
    page.set_input_files("#add-files", str(table))
    expect(page.locator("#add-state")).to_have_text("The CSV file has no column named file.")


def test_what_concerns_all_photos_ends_it(
    locked_server: Server, map_name: str, open_page: OpenPage, tmp_path: Path
) -> None:
    files = [str(file) for file in front_files(tmp_path, 6)]
    page = open_page(locked_server)
    use_key(page, READER)
    page.click("#tab-add")
    page.fill("#add-map", map_name)
    page.set_input_files("#add-files", files)
    state = page.locator("#add-state")
    expect(state).to_contain_text("Stopped with ")
    expect(state).to_contain_text("These credentials do not allow this")
    page.click("#key-button")
    use_key(page, WRITER)
    page.set_input_files("#add-files", files)
    expect(state).to_have_text("Done: 6 added, 0 already there, 0 refused.")


def use_key(page: Page, key: str) -> None:
    """Enter a key into the dialog that is open."""
    dialog = page.get_by_role("dialog")
    expect(dialog).to_be_visible()
    page.fill("#key", key)
    page.get_by_role("button", name="Use it").click()
    expect(dialog).to_be_hidden()
