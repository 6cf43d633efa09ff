"""The client of asyncio against a live server."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable

import pytest

from facades import facade
from live_server import Server
from placeformer import AsyncClient, Conflict, ImageRefused, NewPhoto, NotFound


def run(server: Server, talk: Callable[[AsyncClient], Awaitable[None]]) -> None:
    """Let `talk` use a client."""

    async def main() -> None:
        async with AsyncClient(server.url) as client:
            await talk(client)

    asyncio.run(main())


def test_a_photo_is_stored_found_changed_and_deleted(server: Server, map_name: str) -> None:
    async def talk(client: AsyncClient) -> None:
        stored = await client.add_reference(facade(1), map_name, external_id="1", lat=1.0, lon=2.0)
        assert stored.is_new
        answers = await asyncio.gather(*(client.query(facade(1), map_name) for _ in range(4)))
        for answer in answers:
            assert answer.best is not None
            assert answer.best.reference_id == stored.id
        pair = await client.match(facade(1), reference_id=stored.id)
        assert pair.spatial_score > 0
        changed = await client.update_reference(stored.id, heading=90.0)
        assert changed == await client.reference(stored.id)
        await client.delete_reference(stored.id)
        with pytest.raises(NotFound):
            await client.reference(stored.id)

    run(server, talk)


def test_maps_and_listings(server: Server, map_name: str) -> None:
    async def talk(client: AsyncClient) -> None:
        for seed in range(3):
            await client.add_reference(facade(seed), map_name, external_id=str(seed))
        listed = [one.external_id async for one in client.references(map_name, page_size=2)]
        assert listed == ["0", "1", "2"]
        assert (await client.map(map_name)).references == 3
        calibration = (await client.info()).calibration
        assert calibration is not None
        assert await client.set_calibration(map_name, calibration) == calibration
        await client.remove_calibration(map_name)
        await client.remove_head(map_name)
        with pytest.raises(Conflict):
            await client.add_reference(facade(9), map_name, external_id="0")
        assert (await client.delete_map(map_name)).references_deleted == 3
        assert map_name not in [one.name for one in await client.maps()]
        assert (await client.readiness()).is_ready

    run(server, talk)


def test_an_ingest_gives_a_verdict_for_each_photo_in_order(server: Server, map_name: str) -> None:
    async def photos() -> AsyncIterator[NewPhoto]:
        for seed in range(6):
            content = facade(seed) if seed != 2 else facade(seed)[:300]
            yield NewPhoto(content, {"external_id": str(seed)})

    async def talk(client: AsyncClient) -> None:
        seen: list[int] = []
        verdicts = [
            verdict
            async for verdict in client.ingest(
                photos(), map_name, workers=3, progress=lambda progress: seen.append(progress.done)
            )
        ]
        names = [verdict.photo.fields["external_id"] for verdict in verdicts]
        assert names == ["0", "1", "2", "3", "4", "5"]
        assert [verdict.outcome for verdict in verdicts].count("added") == 5
        assert isinstance(verdicts[2].error, ImageRefused)
        assert seen == [1, 2, 3, 4, 5, 6]
        again = [verdict.outcome async for verdict in client.ingest([], map_name)]
        assert again == []

    run(server, talk)
