"""A photo is dropped, and the page shows which place it shows, and why."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable
from pathlib import Path

from playwright.sync_api import Page, expect

from conftest import add_fronts, front_files
from facades import facade, flat
from live_server import Server
from placeformer import Client

OpenPage = Callable[..., Page]

DROP = """(zone, files) => {
  const transfer = new DataTransfer();
  for (const [name, content] of files) {
    const bytes = Uint8Array.from(atob(content), (letter) => letter.charCodeAt(0));
    transfer.items.add(new File([bytes], name, { type: "image/png" }));
  }
  zone.dispatchEvent(new DragEvent("drop", { dataTransfer: transfer, cancelable: true }));
}"""


def drop(page: Page, zone: str, files: list[tuple[str, bytes]]) -> None:
    """Drop files as a person does with the mouse."""
    encoded = [[name, base64.b64encode(content).decode()] for name, content in files]
    page.locator(zone).evaluate(DROP, encoded)


def pixels(page: Page, canvas: str) -> str:
    """What a canvas shows."""
    text: str = page.locator(canvas).evaluate("(canvas) => canvas.toDataURL()")
    return text


def test_a_dropped_photo_is_answered_with_its_place_and_the_evidence(
    server: Server, client: Client, map_name: str, open_page: OpenPage
) -> None:
    add_fronts(client, map_name, 5)
    page = open_page(server, map_name)
    drop(page, "#locate-drop", [("frame.png", facade(3))])
    ranks = page.locator(".ranks button")
    expect(ranks).to_have_count(5)
    expect(ranks.first).to_contain_text("1. front-3.png")
    expect(ranks.first).to_have_attribute("aria-current", "true")
    expect(page.locator(".verdict")).to_contain_text("front-3.png")
    answer = client.query(facade(3), map_name)
    assert answer.best is not None and answer.confidence is not None
    explanation = page.locator("#explanation")
    expect(explanation).to_contain_text(f"{answer.best.spatial_score} pairs of patches agree")
    expect(explanation).to_contain_text(f"probability of {100 * answer.confidence:.1f}%")

    # The table of the evidence adds up to the score.
    expect(page.locator("#pair")).to_be_visible()
    caption = page.locator("#evidence caption").inner_text()
    inliers = [int(text) for text in page.locator("#evidence td:last-child").all_inner_texts()]
    assert f"Score: {sum(inliers)}," in caption
    assert sum(inliers) == answer.best.spatial_score
    expect(page.locator("#pair")).to_have_attribute("aria-label", re.compile(r"\d+ pairs agree"))
    expect(page.locator("#stages-of-answer")).to_contain_text("extract")


def test_a_photo_that_shows_nothing_is_told_so(
    server: Server, client: Client, map_name: str, open_page: OpenPage
) -> None:
    add_fronts(client, map_name, 2)
    page = open_page(server, map_name)
    drop(page, "#locate-drop", [("covered.png", flat((12, 12, 14)))])
    expect(page.locator(".verdict")).to_contain_text("shows nothing")
    expect(page.locator("#explanation")).to_contain_text("the lens is covered")


def test_what_is_drawn_can_be_chosen(
    server: Server, client: Client, map_name: str, open_page: OpenPage, tmp_path: Path
) -> None:
    add_fronts(client, map_name, 2)
    page = open_page(server, map_name)
    drop(page, "#locate-drop", [("frame.png", facade(1))])
    expect(page.locator("#pair")).to_be_visible()
    seen = {pixels(page, "#pair")}
    for label in [
        "pairs that agree",
        "key patches 1×1",
        "key patches 2×2",
        "key patches 3×3",
    ]:
        page.get_by_label(label).uncheck()
        seen.add(pixels(page, "#pair"))
    page.get_by_label("pairs that agree").check()
    for combination in ["s11", "s23"]:
        page.select_option("#combination", combination)
        seen.add(pixels(page, "#pair"))
    assert len(seen) == 7
    # With the map's photos at hand, the place is seen, too.
    expect(page.locator("figcaption")).to_contain_text("keeps no pictures")
    page.locator("#pictures summary").click()
    page.set_input_files("#picture-files", [str(file) for file in front_files(tmp_path, 2)])
    expect(page.locator("#picture-count")).to_have_text("2 pictures known.")
    expect(page.locator("figcaption")).to_have_text("First your photo, then the place.")
    assert pixels(page, "#pair") not in seen


def test_another_picture_of_the_same_name_is_noticed(
    server: Server, client: Client, map_name: str, open_page: OpenPage, tmp_path: Path
) -> None:
    add_fronts(client, map_name, 1)
    (tmp_path / "front-0.png").write_bytes(facade(77))
    page = open_page(server, map_name)
    page.locator("#pictures summary").click()
    page.set_input_files("#picture-files", str(tmp_path / "front-0.png"))
    drop(page, "#locate-drop", [("frame.png", facade(0))])
    expect(page.locator("figcaption")).to_contain_text("but another content")


def test_a_drive_is_asked_about_photo_by_photo(
    server: Server, client: Client, map_name: str, open_page: OpenPage
) -> None:
    add_fronts(client, map_name, 4)
    page = open_page(server, map_name)
    photos = [(f"frame-{seed}.png", facade(seed)) for seed in (2, 0, 3)]
    drop(page, "#locate-drop", [*photos, ("broken.png", facade(1)[:400])])
    notes = page.locator("#frames small")
    expect(notes).to_have_count(4)
    expect(notes.last).to_have_text("failed")
    expect(page.locator("#answer-state")).to_have_text("broken.png: failed")
    page.locator("#frames button").nth(2).click()
    expect(page.locator(".ranks button").first).to_contain_text("1. front-3.png")
    page.locator("#frames button").nth(3).click()
    expect(page.locator("#answer .verdict")).to_contain_text("The image cannot be decoded")
    expect(page.locator("#answer .verdict")).to_contain_text("request ")


def test_options_reach_the_server(
    server: Server, client: Client, map_name: str, open_page: OpenPage
) -> None:
    add_fronts(client, map_name, 3)
    page = open_page(server, map_name)
    page.locator("#locate-options summary").click()
    page.fill("#top-k", "2")
    page.uncheck("#rerank")
    drop(page, "#locate-drop", [("frame.png", facade(1))])
    expect(page.locator(".ranks button")).to_have_count(2)
    expect(page.locator(".ranks button").first).to_contain_text("not compared")
    expect(page.locator("#explanation")).to_contain_text("The patches were not compared")


def test_names_stay_text(
    server: Server, client: Client, map_name: str, open_page: OpenPage
) -> None:
    name = "<img src=x onerror=document.title='taken'>.png"
    client.add_reference(facade(5), map_name, external_id=name, lat=51.0, lon=7.0)
    page = open_page(server, map_name)
    drop(page, "#locate-drop", [(name, facade(5))])
    expect(page.locator("#pair")).to_be_visible()
    expect(page.locator(".verdict")).to_contain_text("onerror")
    page.get_by_role("button", name="Show on the map").click()
    expect(page.locator("#reference")).to_contain_text("onerror")
    assert page.title() == "PlaceFormer console"
    assert page.locator("img[src=x]").count() == 0
