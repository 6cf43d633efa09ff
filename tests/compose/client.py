"""HTTP against the composed system: the standard library only."""

import http.client
import json
import time
import urllib.parse


class Refused(Exception):
    """The server answered, but not with what was wanted."""


def request(port, method, path, params=None, body=None, headers=None, timeout=60):
    """One request on a connection of its own; returns status, headers and the JSON (or text) of the answer."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=timeout)
    target = path + ("?" + urllib.parse.urlencode(params) if params else "")
    try:
        connection.request(method, target, body=body, headers=headers or {})
        answer = connection.getresponse()
        text = answer.read()
    finally:
        connection.close()
    try:
        content = json.loads(text)
    except ValueError:
        content = text.decode(errors="replace")
    return answer.status, dict((k.lower(), v) for k, v in answer.getheaders()), content


def post_image(port, path, image, **params):
    return request(port, "POST", path, params, image, {"Content-Type": "image/png"})


def ingest(port, map_name, name, image):
    """Stores an image; returns the status (201 new, 200 there before) and the reference."""
    status, _, content = post_image(port, "/references", image, map=map_name, external_id=name)
    if status not in (200, 201):
        raise Refused(f"POST /references: {status} {content}")
    return status, content


def query(port, map_name, image, **options):
    status, _, content = post_image(port, "/query", image, map=map_name, **options)
    if status != 200:
        raise Refused(f"POST /query: {status} {content}")
    return content


def with_retries(call, seconds=90):
    """What a vehicle does: on a refused connection or a 503 it comes back, after Retry-After where one was given."""
    deadline = time.monotonic() + seconds
    attempts = 0
    while True:
        attempts += 1
        wait = 0.5
        try:
            status, headers, content = call()
            if status != 503:
                return status, content, attempts
            if "retry-after" not in headers:
                raise AssertionError(f"a 503 without Retry-After: {content}")
            wait = float(headers["retry-after"])
        except (OSError, http.client.HTTPException):
            pass
        if time.monotonic() + wait > deadline:
            raise AssertionError(f"no answer within {seconds} s and {attempts} attempts")
        time.sleep(wait)


def references(port, map_name):
    """Every reference of a map, through the cursor."""
    found, cursor = [], None
    while True:
        params = {"map": map_name, "limit": 7}
        if cursor:
            params["cursor"] = cursor
        status, _, page = request(port, "GET", "/references", params)
        if status != 200:
            raise Refused(f"GET /references: {status} {page}")
        found += page["references"]
        cursor = page["next"]
        if not cursor:
            return found
