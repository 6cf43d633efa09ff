#!/usr/bin/env python3
"""A vehicle that asks where it is while it drives.

It plays the photos of a folder as the frames of a camera and prints a line for each answer:

    pip install clients/python
    examples/vehicle.py --server http://127.0.0.1:8080 --map town --frames ./drive

A vehicle is at another place by the time that a late answer comes. So only the newest frame is
asked about: while a request is under way, frames are dropped; each request has a deadline; a
failed one is not repeated with an old frame. When the service is busy, the vehicle leaves it alone
for as long as it asks for. An answer below the map's threshold is no answer.
"""

from __future__ import annotations

import argparse
import asyncio
import time
from collections import Counter
from pathlib import Path

from placeformer import (
    NO_RETRY,
    AsyncClient,
    ConnectionFailed,
    PlaceFormerError,
    QueryAnswer,
    Unavailable,
)

PAUSE_WHEN_BUSY_SECONDS = 1.0


class Vehicle:
    """Asks about one frame at a time, and counts what became of the frames."""

    def __init__(self, client: AsyncClient, map_name: str, deadline_ms: int) -> None:
        self.client = client
        self.map_name = map_name
        self.deadline_ms = deadline_ms
        self.asking: asyncio.Task[None] | None = None
        self.silent_until = 0.0
        self.outcomes: Counter[str] = Counter()

    def see(self, frame: Path) -> None:
        """Take a frame from the camera: ask about it, or drop it."""
        is_busy = self.asking is not None and not self.asking.done()
        if is_busy or time.monotonic() < self.silent_until:
            self.outcomes["dropped"] += 1
        else:
            self.asking = asyncio.create_task(self.ask(frame))

    async def ask(self, frame: Path) -> None:
        """Ask where a frame was taken."""
        started = time.monotonic()
        try:
            answer = await self.client.query(
                frame, self.map_name, top_k=1, deadline_ms=self.deadline_ms
            )
        except Unavailable as error:
            wait = error.retry_after or PAUSE_WHEN_BUSY_SECONDS
            self.leave_alone(frame, f"{error.code}, back in {wait:.0f} s", wait)
        except ConnectionFailed as error:
            self.leave_alone(frame, str(error), PAUSE_WHEN_BUSY_SECONDS)
        else:
            took = 1000 * (time.monotonic() - started)
            self.outcomes["placed" if answer.matched else "unsure"] += 1
            print(f"{frame.name}: {in_words(answer)} ({took:.0f} ms)", flush=True)

    def leave_alone(self, frame: Path, cause: str, seconds: float) -> None:
        """Ask nothing for a while."""
        self.silent_until = time.monotonic() + seconds
        self.outcomes["failed"] += 1
        print(f"{frame.name}: {cause}", flush=True)


def in_words(answer: QueryAnswer) -> str:
    """What a driver would be told."""
    best = answer.best
    if best is None or not answer.matched:
        confidence = answer.confidence or 0.0
        return f"not sure where this is (confidence {confidence:.2f})"
    name = best.external_id or best.reference_id
    if best.location is None or best.location.lat is None:
        return f"at {name}"
    return f"at {best.location.lat:.6f}, {best.location.lon:.6f} ({name})"


async def drive(arguments: argparse.Namespace) -> None:
    """Play the frames at the camera's rate."""
    frames = sorted(path for path in arguments.frames.iterdir() if path.suffix == ".jpg")
    async with AsyncClient(arguments.server, api_key=arguments.key, retry=NO_RETRY) as client:
        vehicle = Vehicle(client, arguments.map, arguments.deadline_ms)
        for frame in frames:
            vehicle.see(frame)
            await asyncio.sleep(1.0 / arguments.rate)
            if vehicle.asking is not None and vehicle.asking.done():
                # An error that no later frame would change, such as a wrong key, ends the drive.
                vehicle.asking.result()
        if vehicle.asking is not None:
            await vehicle.asking
    counts = ", ".join(f"{count} {name}" for name, count in sorted(vehicle.outcomes.items()))
    print(f"{len(frames)} frames: {counts or 'none'}")


def main() -> None:
    """Read the command line and drive."""
    parser = argparse.ArgumentParser(description="Asks where each frame of a drive was taken.")
    parser.add_argument("--server", default="http://127.0.0.1:8080")
    parser.add_argument("--map", required=True)
    parser.add_argument("--frames", type=Path, required=True, help="folder of JPEGs, by name")
    parser.add_argument("--rate", type=float, default=2.0, help="frames a second")
    parser.add_argument("--deadline-ms", type=int, default=1000)
    parser.add_argument("--key", help="API key")
    try:
        asyncio.run(drive(parser.parse_args()))
    except PlaceFormerError as error:
        parser.exit(1, f"{error}\n")


if __name__ == "__main__":
    main()
