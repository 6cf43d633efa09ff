"""House fronts drawn for tests: the standard library only."""

from __future__ import annotations

import random
import struct
import zlib
from collections.abc import Iterable


def facade(seed: int, width: int = 320, height: int = 240) -> bytes:
    """A PNG of a house front that no other seed gives: walls, windows, doors and signs."""
    dice = random.Random(seed)
    wall = bytes(dice.randrange(60, 220) for _ in range(3))
    rows = [bytearray(wall * width) for _ in range(height)]

    def rectangle(x: int, y: int, w: int, h: int, colour: list[int]) -> None:
        for line in rows[max(0, y) : min(height, y + h)]:
            end = min(width, x + w)
            line[3 * x : 3 * end] = bytes(colour) * (end - x)

    for _ in range(40):
        x, y = dice.randrange(width - 12), dice.randrange(height - 12)
        colour = [dice.randrange(256) for _ in range(3)]
        rectangle(x, y, dice.randrange(8, 70), dice.randrange(8, 60), colour)
    return png(width, height, rows)


def flat(colour: tuple[int, int, int], width: int = 320, height: int = 240) -> bytes:
    """A PNG of one colour."""
    return png(width, height, [bytes(colour) * width] * height)


def png(width: int, height: int, rows: Iterable[bytes | bytearray]) -> bytes:
    """An RGB PNG of rows of pixels."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        checksum = struct.pack(">I", zlib.crc32(kind + body))
        return struct.pack(">I", len(body)) + kind + body + checksum

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    # Each row begins with the number of its filter, of which 0 is none.
    pixels = zlib.compress(b"".join(b"\0" + bytes(row) for row in rows), 6)
    head = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header)
    return head + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
