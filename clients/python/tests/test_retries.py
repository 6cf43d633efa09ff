"""When the client tries again, with a transport that answers what a test wants."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from email.utils import format_datetime

import httpx
import pytest

from facades import facade
from placeformer import (
    ApiError,
    AsyncClient,
    Client,
    ConnectionFailed,
    NotFound,
    PlaceFormerError,
    Retry,
    Unavailable,
    UnexpectedAnswer,
)
from placeformer._retry import parse_retry_after

Answer = httpx.Response | httpx.TransportError

INFO = {
    "version": "1",
    "model": "m",
    "input_size": {"width": 1, "height": 1},
    "scales": [],
    "limits": dict.fromkeys(
        (
            "max_image_bytes",
            "top_k",
            "candidates",
            "max_candidates",
            "deadline_ms",
            "max_metadata_bytes",
            "max_page",
        ),
        1,
    ),
}
OK = httpx.Response(200, json=INFO)


def problem(
    code: str, status: int, *, retryable: bool, retry_after: str | None = None
) -> httpx.Response:
    headers = {} if retry_after is None else {"retry-after": retry_after}
    body = {
        "type": f"urn:placeformer:error:{code}",
        "title": "a title",
        "status": status,
        "code": code,
        "detail": "the cause",
        "request_id": "id-7",
        "retryable": retryable,
    }
    return httpx.Response(status, json=body, headers=headers)


BUSY = problem("overloaded", 503, retryable=True, retry_after="3")
BROKEN = problem("internal", 500, retryable=True)
UNREACHABLE = httpx.ConnectError("refused")
CUT_OFF = httpx.ReadError("")


class Script:
    """Answers requests in turn, and notes how often it was asked and how long was waited."""

    def __init__(self, *answers: Answer) -> None:
        self.answers = list(answers)
        self.asked = 0
        self.waits: list[float] = []

    def __call__(self, _: httpx.Request) -> httpx.Response:
        answer = self.answers[min(self.asked, len(self.answers) - 1)]
        self.asked += 1
        if isinstance(answer, httpx.TransportError):
            raise answer
        return httpx.Response(answer.status_code, headers=answer.headers, content=answer.content)


@pytest.fixture(params=["sync", "async"])
def run(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., PlaceFormerError | None]:
    """Ask a script until the client is content or gives up; returns why it gave up."""

    def run(
        script: Script, *, store: bool = False, external_id: str | None = None
    ) -> PlaceFormerError | None:
        transport = httpx.MockTransport(script)
        image = facade(1)

        async def sleep(seconds: float) -> None:
            script.waits.append(seconds)

        async def ask() -> None:
            async with AsyncClient("http://vpr", transport=transport) as client:
                if store:
                    await client.add_reference(image, "m", external_id=external_id)
                else:
                    await client.info()

        monkeypatch.setattr(time, "sleep", script.waits.append)
        monkeypatch.setattr(asyncio, "sleep", sleep)
        try:
            if request.param == "async":
                asyncio.run(ask())
                return None
            with Client("http://vpr", transport=transport) as client:
                if store:
                    client.add_reference(image, "m", external_id=external_id)
                else:
                    client.info()
        except PlaceFormerError as error:
            return error
        return None

    return run


def test_a_busy_service_is_asked_again_when_it_says(run: Callable[..., object]) -> None:
    script = Script(BUSY, BUSY, OK)
    assert run(script) is None
    assert script.asked == 3
    assert all(wait >= 3.0 for wait in script.waits), script.waits


def test_waits_grow_where_the_service_does_not_say(run: Callable[..., object]) -> None:
    script = Script(UNREACHABLE, UNREACHABLE, BROKEN, BROKEN, OK)
    assert run(script) is None
    assert script.asked == 5
    for wait, most in zip(script.waits, (0.25, 0.5, 1.0, 2.0), strict=True):
        assert most / 2 <= wait <= most


def test_what_cannot_pass_is_raised_at_once(run: Callable[..., PlaceFormerError | None]) -> None:
    script = Script(problem("map_not_found", 404, retryable=False))
    error = run(script)
    assert isinstance(error, NotFound)
    assert (error.code, error.request_id, error.retryable) == ("map_not_found", "id-7", False)
    assert script.asked == 1
    for too_long in (
        problem("disk_full", 507, retryable=True, retry_after="3600"),
        problem("rate_limited", 429, retryable=True, retry_after="31"),
    ):
        script = Script(too_long)
        assert isinstance(run(script), Unavailable)
        assert script.asked == 1


def test_the_last_error_is_raised_when_patience_ends(
    run: Callable[..., PlaceFormerError | None],
) -> None:
    script = Script(BROKEN, BROKEN, BROKEN, BROKEN, BUSY)
    error = run(script)
    assert isinstance(error, Unavailable)
    assert error.retry_after == 3.0
    assert script.asked == 5


def test_a_photo_is_not_sent_twice_unless_that_is_safe(
    run: Callable[..., PlaceFormerError | None],
) -> None:
    cases: list[tuple[Answer, str | None, int]] = [
        # It might be stored, and nobody could tell.
        (CUT_OFF, None, 1),
        (BROKEN, None, 1),
        # It has a name, or was certainly not stored.
        (CUT_OFF, "a name", 5),
        (BROKEN, "a name", 5),
        (BUSY, None, 5),
        (UNREACHABLE, None, 5),
    ]
    for answer, external_id, asked in cases:
        script = Script(answer)
        error = run(script, store=True, external_id=external_id)
        assert isinstance(error, (ApiError, ConnectionFailed))
        assert script.asked == asked, (answer, external_id)


def test_answers_of_others_are_no_answers(run: Callable[..., PlaceFormerError | None]) -> None:
    for answer in (
        httpx.Response(404, text="<html>nothing here</html>"),
        httpx.Response(200, json={"version": 7}),
        httpx.Response(200, text="hello"),
        httpx.Response(302, headers={"location": "http://elsewhere/"}),
    ):
        script = Script(answer)
        assert isinstance(run(script), UnexpectedAnswer)
        assert script.asked == 1


def test_a_proxy_that_cannot_reach_the_service_is_asked_again(
    run: Callable[..., PlaceFormerError | None],
) -> None:
    gateway = httpx.Response(502, text="<html>bad gateway</html>")
    script = Script(gateway, OK)
    assert run(script) is None
    assert script.asked == 2
    # It may have reached it, so that a photo without a name might be stored twice.
    script = Script(gateway)
    assert isinstance(run(script, store=True), UnexpectedAnswer)
    assert script.asked == 1


def test_a_code_of_a_newer_service_is_an_error_all_the_same(
    run: Callable[..., PlaceFormerError | None],
) -> None:
    error = run(Script(problem("not_invented_yet", 418, retryable=False)))
    assert type(error) is ApiError
    assert error.code == "not_invented_yet"


def test_a_date_says_when_to_come_back_as_well_as_a_number() -> None:
    soon = datetime.now(timezone.utc) + timedelta(seconds=100)
    for text, least, most in [
        ("7", 7.0, 7.0),
        (format_datetime(soon, usegmt=True), 90.0, 100.0),
        ("Thu, 01 Jan 1970 00:00:00 GMT", 0.0, 0.0),
    ]:
        seconds = parse_retry_after({"retry-after": text})
        assert seconds is not None
        assert least <= seconds <= most, text
    assert parse_retry_after({}) is None
    assert parse_retry_after({"retry-after": "soon"}) is None


def test_a_policy_may_forbid_to_try_again() -> None:
    script = Script(UNREACHABLE)
    transport = httpx.MockTransport(script)
    policy = Retry(attempts=1)
    client = Client("http://vpr", transport=transport, retry=policy)
    with client, pytest.raises(ConnectionFailed, match="GET /info: refused"):
        client.info()
    assert script.asked == 1


def test_an_address_that_is_none_is_refused() -> None:
    for url in ("127.0.0.1:8080", "ftp://host", "http://", ""):
        with pytest.raises(ValueError, match="no address of a service"):
            Client(url)
