"""HTTP against the composed system, and test images: the standard library only."""

import http.client
import json
import random
import struct
import time
import urllib.parse
import zlib


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


def facade(seed, width=320, height=240):
    """A PNG of a house front that no other seed gives: coloured walls, windows, doors and signs."""
    dice = random.Random(seed)
    rows = [bytearray(bytes(dice.randrange(60, 220) for _ in range(3)) * width) for _ in range(height)]

    def rectangle(x, y, w, h, colour):
        for line in rows[max(0, y) : min(height, y + h)]:
            end = min(width, x + w)
            line[3 * x : 3 * end] = bytes(colour) * (end - x)

    for _ in range(40):
        x, y = dice.randrange(width - 12), dice.randrange(height - 12)
        colour = [dice.randrange(256) for _ in range(3)]
        rectangle(x, y, dice.randrange(8, 70), dice.randrange(8, 60), colour)
    return png(width, height, b"".join(b"\0" + bytes(row) for row in rows))


def png(width, height, rows):
    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows, 6)) + chunk(b"IEND", b"")
