"""The map: references at their places, and what is missing between them."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from playwright.sync_api import Page, expect

from facades import facade
from live_server import Server
from placeformer import Client
from test_locate import drop, pixels

OpenPage = Callable[..., Page]

METRES_PER_DEGREE = 111_320


@pytest.fixture
def street(client: Client, map_name: str) -> str:
    """A street to the north: three photos, a gap of 60 m, and two photos, one looking back."""
    for seed, (north, heading) in enumerate([(0, 0), (10, 0), (20, 0), (80, 0), (90, 180)]):
        client.add_reference(
            facade(seed),
            map_name,
            external_id=f"drive/{seed}.png",
            lat=51.0 + north / METRES_PER_DEGREE,
            lon=7.0,
            heading=float(heading),
        )
    client.add_reference(facade(5), map_name, external_id="indoors")
    return map_name


def test_references_gaps_and_directions(server: Server, street: str, open_page: OpenPage) -> None:
    page = open_page(server, street)
    page.click("#tab-map")
    expect(page.locator("#map-state")).to_contain_text("5 references with a position; 1 without")
    coverage = page.locator("#coverage")
    expect(coverage).to_contain_text("60 m without a photo")
    expect(coverage.locator("dd").nth(0)).to_have_text("2")
    expect(coverage.locator("dd").nth(1)).to_have_text("1 of 25 to 200 m")
    # The first three look north only; the last two look at each other.
    expect(coverage.locator("dd").nth(2)).to_have_text("60% of 5")
    before = pixels(page, "#map-canvas")
    page.uncheck("#show-gaps")
    without_gaps = pixels(page, "#map-canvas")
    page.check("#show-one-way")
    assert len({before, without_gaps, pixels(page, "#map-canvas")}) == 3
    coverage.get_by_role("button", name="60 m without a photo").click()
    expect(page.locator("#reference")).to_contain_text("drive/")


def test_it_can_be_moved_zoomed_and_clicked(
    server: Server, street: str, open_page: OpenPage
) -> None:
    page = open_page(server, street)
    page.click("#tab-map")
    expect(page.locator("#coverage")).to_contain_text("Stretches")
    box = page.locator("#map-canvas").bounding_box()
    assert box is not None
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    seen = [pixels(page, "#map-canvas")]

    def changed() -> None:
        seen.append(pixels(page, "#map-canvas"))
        assert seen[-1] != seen[-2]

    page.mouse.move(*middle)
    page.mouse.wheel(0, -300)
    changed()
    page.mouse.down()
    page.mouse.move(middle[0] + 50, middle[1] + 80, steps=4)
    page.mouse.up()
    changed()
    for button in ("Zoom in", "Zoom out", "Whole map"):
        page.get_by_role("button", name=button).click()
        changed()
    # The whole map has its southernmost photo 6% of its height above the lower edge.
    page.mouse.click(middle[0], box["y"] + 0.94 * box["height"])
    expect(page.locator("#reference")).to_contain_text("drive/0.png")
    expect(page.locator("#reference")).to_contain_text("0°, north")
    expect(page.locator("#reference")).to_contain_text("keeps no pictures")


def test_colours_and_their_legend(server: Server, street: str, open_page: OpenPage) -> None:
    page = open_page(server, street)
    page.click("#tab-map")
    expect(page.locator("#legend")).to_contain_text("5 by the time they were added")
    by_age = pixels(page, "#map-canvas")
    page.select_option("#colour-by", "heading")
    expect(page.locator("#legend")).to_contain_text("looking south")
    by_heading = pixels(page, "#map-canvas")
    page.select_option("#colour-by", "score")
    expect(page.locator("#legend")).to_have_text("Ask about a photo first.")
    page.click("#tab-locate")
    drop(page, "#locate-drop", [("frame.png", facade(1))])
    page.get_by_role("button", name="Show on the map").click()
    expect(page.locator("#map-canvas")).to_be_focused()
    expect(page.locator("#reference")).to_contain_text("drive/1.png")
    expect(page.locator("#legend")).to_contain_text("agreeing pairs")
    assert len({by_age, by_heading, pixels(page, "#map-canvas")}) == 3
