"""Keys, the server's state, and what the page may do."""

from __future__ import annotations

from collections.abc import Callable

from playwright.sync_api import Page, expect

from conftest import READER, add_fronts
from facades import facade
from live_server import Server
from placeformer import Client
from test_add import use_key
from test_locate import drop

OpenPage = Callable[..., Page]


def test_a_key_is_asked_for_once_and_kept_in_the_tab_only(
    locked_server: Server, open_page: OpenPage
) -> None:
    page = open_page(locked_server)
    use_key(page, "a wrong key")
    expect(page.get_by_role("dialog")).to_contain_text("Credentials are missing or wrong")
    use_key(page, READER)
    expect(page.locator("#notice")).to_be_empty()
    page.click("#tab-server")
    expect(page.locator("#server-info")).to_contain_text("dinov2-vits14")
    page.reload()
    expect(page.locator("#server-info")).to_contain_text("dinov2-vits14")
    expect(page.get_by_role("dialog")).to_be_hidden()
    kept = page.evaluate("JSON.stringify([localStorage, document.cookie])")
    assert READER not in kept
    # Another tab knows nothing of it.
    other = page.context.new_page()
    other.goto(f"{locked_server.url}/")
    expect(other.get_by_role("dialog")).to_be_visible()
    other.close()
    page.click("#key-button")
    page.get_by_role("button", name="Forget it").click()
    expect(page.get_by_role("dialog")).to_contain_text("Credentials are missing")
    assert page.evaluate("sessionStorage.getItem('placeformer-key')") is None


def test_stages_and_queue_are_live(
    server: Server, client: Client, map_name: str, open_page: OpenPage
) -> None:
    add_fronts(client, map_name, 2)
    page = open_page(server, map_name)
    page.click("#tab-server")
    expect(page.locator("#server-state")).to_have_text("The server is ready.")
    client.query(facade(1), map_name)
    row = page.locator("#stages tr", has_text="extract")
    expect(page.locator("#stage-window")).to_contain_text("Of the last")
    expect(row.locator("td").nth(0)).to_have_text("1")
    expect(row.locator("td").nth(1)).to_contain_text("ms")
    expect(page.locator("#queue-state")).to_contain_text("waiting or in work")
    expect(page.locator("#server-info")).to_contain_text(f"{map_name} (2)")


def test_a_server_that_starts_or_is_away_is_waited_for(
    server: Server, open_page: OpenPage
) -> None:
    page = open_page(server)
    expect(page.locator("#notice")).to_be_empty()
    page.route("**/readyz*", lambda route: route.abort())
    page.reload()
    expect(page.locator("#notice")).to_have_text("The server does not answer.")
    page.unroute("**/readyz*")
    progress = {"done": 25, "total": 100}
    body = {"status": "building_index", "progress": progress, "detail": None}
    page.route("**/readyz*", lambda route: route.fulfill(status=503, json=body))
    expect(page.locator("#notice")).to_have_text("The server builds its index. 25%")
    page.unroute("**/readyz*")
    expect(page.locator("#notice")).to_be_empty()


def test_a_busy_server_is_asked_again(
    server: Server, client: Client, map_name: str, open_page: OpenPage
) -> None:
    add_fronts(client, map_name, 1)
    page = open_page(server, map_name)
    asked: list[str] = []
    busy = {"code": "overloaded", "title": "The server is at capacity", "detail": "busy"}

    def answer_once(route: object) -> None:
        asked.append("query")
        if len(asked) == 1:
            route.fulfill(status=503, json=busy, headers={"retry-after": "1"})  # type: ignore[attr-defined]
        else:
            route.continue_()  # type: ignore[attr-defined]

    page.route("**/query?*", answer_once)
    drop(page, "#locate-drop", [("frame.png", facade(0))])
    expect(page.locator(".ranks button")).to_have_count(1)
    assert len(asked) == 2


def test_the_page_runs_nothing_but_its_own_files(server: Server, open_page: OpenPage) -> None:
    page = open_page(server, provokes_problems=True)
    outcome = page.evaluate(
        """async () => {
          const violations = [];
          document.addEventListener("securitypolicyviolation", (event) =>
            violations.push(event.effectiveDirective));
          const script = document.createElement("script");
          script.textContent = "window.taken = true";
          document.body.append(script);
          document.body.setAttribute("onclick", "window.taken = true");
          document.body.click();
          const styled = document.createElement("p");
          styled.setAttribute("style", "color: red");
          document.body.append(styled);
          await fetch("http://192.0.2.1/").catch(() => {});
          await new Promise((resolve) => setTimeout(resolve, 100));
          return [window.taken ?? false, violations.sort()];
        }"""
    )
    assert outcome[0] is False
    blocked = {"connect-src", "script-src-attr", "script-src-elem", "style-src-attr"}
    assert blocked <= set(outcome[1]), outcome
