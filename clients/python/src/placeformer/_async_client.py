"""The client for programs that do other things while they wait, with asyncio.

Images are read and encoded on threads, so that the event loop is not held up.
"""

from __future__ import annotations

import asyncio
import os
from collections import deque
from collections.abc import AsyncIterable, AsyncIterator, Iterable
from pathlib import Path
from types import TracebackType
from typing import TypeVar

import httpx
from typing_extensions import Self, Unpack

from . import _operations as operations
from ._bulk import OF_ONE_PHOTO, Counter, NewPhoto, ProgressCallback, Verdict, refused, stored
from ._errors import PlaceFormerError
from ._exchange import answer_of, connection_settings, failure_of, request_of
from ._images import ImageInput
from ._models import (
    Calibration,
    Info,
    Map,
    MapDeleted,
    MatchAnswer,
    QueryAnswer,
    Readiness,
    Reference,
    StoredReference,
)
from ._operations import Operation
from ._options import NewReferenceOptions, QueryOptions, ReferenceFields
from ._retry import Retry

T = TypeVar("T")


class AsyncClient:
    """A client of one service, for asyncio. Arguments and errors are those of `Client`."""

    def __init__(
        self,
        url: str,
        *,
        api_key: str | None = None,
        timeout: float = 60.0,
        retry: Retry | None = None,
        ca_cert: str | os.PathLike[str] | None = None,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        settings = connection_settings(url, api_key, timeout, ca_cert)
        self._http = httpx.AsyncClient(transport=transport, **settings)
        self._retry = Retry() if retry is None else retry

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self.aclose()

    async def aclose(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def info(self) -> Info:
        """Tell what the server runs, and the bounds of requests."""
        return await self._run(operations.info())

    async def readiness(self) -> Readiness:
        """Tell whether the server takes requests, or why not."""
        return await self._run(operations.readiness())

    async def query(
        self,
        image: ImageInput,
        map: str,  # noqa: A002
        **options: Unpack[QueryOptions],
    ) -> QueryAnswer:
        """Find the places that a photo may show, best first."""
        return await self._run(await asyncio.to_thread(operations.query, image, map, options))

    async def match(
        self,
        image: ImageInput,
        reference: ImageInput | None = None,
        *,
        reference_id: str | None = None,
        key_patches: bool | None = None,
    ) -> MatchAnswer:
        """Compare a photo with another one, or with a stored reference, and show the evidence."""
        arguments = (image, reference, reference_id, key_patches)
        return await self._run(await asyncio.to_thread(operations.match, *arguments))

    async def add_reference(
        self,
        image: ImageInput,
        map: str,  # noqa: A002
        **fields: Unpack[NewReferenceOptions],
    ) -> StoredReference:
        """Store a photo in a map, as `Client.add_reference` does."""
        operation = await asyncio.to_thread(operations.add_reference, image, map, fields)
        return await self._run(operation)

    async def ingest(
        self,
        photos: Iterable[NewPhoto] | AsyncIterable[NewPhoto],
        map: str,  # noqa: A002
        *,
        workers: int = 4,
        progress: ProgressCallback | None = None,
    ) -> AsyncIterator[Verdict]:
        """Store many photos in a map, as `Client.ingest` does."""
        counter = Counter(photos, progress)
        pending: deque[asyncio.Task[Verdict]] = deque()
        try:
            async for photo in _each(photos):
                pending.append(asyncio.create_task(self._store(photo, map)))
                if len(pending) >= workers:
                    yield counter.count(await pending.popleft())
            while pending:
                yield counter.count(await pending.popleft())
        finally:
            for task in pending:
                task.cancel()
            await asyncio.gather(*pending, return_exceptions=True)

    async def reference(self, reference_id: str) -> Reference:
        """Show a stored reference."""
        return await self._run(operations.reference(reference_id))

    async def references(
        self,
        map: str | None = None,  # noqa: A002
        *,
        external_id: str | None = None,
        page_size: int | None = None,
    ) -> AsyncIterator[Reference]:
        """List references, of a map or of all, in the order they were added."""
        cursor = None
        while True:
            operation = operations.list_references(map, external_id, cursor, page_size)
            page = await self._run(operation)
            for reference in page.references:
                yield reference
            cursor = page.next
            if cursor is None:
                return

    async def update_reference(
        self, reference_id: str, **changes: Unpack[ReferenceFields]
    ) -> Reference:
        """Change the fields that are given; `None` clears one."""
        return await self._run(operations.update_reference(reference_id, **changes))

    async def delete_reference(self, reference_id: str) -> None:
        """Delete a reference."""
        await self._run(operations.delete_reference(reference_id))

    async def maps(self) -> list[Map]:
        """List all maps by name."""
        return await self._run(operations.maps())

    async def map(self, name: str) -> Map:
        """Show a map."""
        return await self._run(operations.map_(name))

    async def delete_map(self, name: str) -> MapDeleted:
        """Delete a map with all its references."""
        return await self._run(operations.delete_map(name))

    async def set_calibration(self, name: str, calibration: Calibration) -> Calibration:
        """Calibrate a map."""
        return await self._run(operations.set_calibration(name, calibration))

    async def remove_calibration(self, name: str) -> None:
        """Remove a map's calibration."""
        await self._run(operations.remove_calibration(name))

    async def set_head(self, name: str, head: str | os.PathLike[str]) -> Map:
        """Give a map the head in this safetensors file."""
        content = await asyncio.to_thread(Path(head).read_bytes)
        return await self._run(operations.set_head(name, content))

    async def remove_head(self, name: str) -> Map:
        """Give a map the server's head."""
        return await self._run(operations.remove_head(name))

    async def _store(self, photo: NewPhoto, map_name: str) -> Verdict:
        try:
            return stored(photo, await self.add_reference(photo.image, map_name, **photo.fields))
        except OF_ONE_PHOTO as error:
            return refused(photo, error)

    async def _run(self, operation: Operation[T]) -> T:
        """Carry out an operation, as often as the policy allows."""
        attempt = 1
        while True:
            try:
                return await self._send(operation)
            except PlaceFormerError as error:
                repeatable = operation.is_repeatable
                wait = self._retry.wait_after(error, attempt, is_repeatable=repeatable)
                if wait is None:
                    raise
            await asyncio.sleep(wait)
            attempt += 1

    async def _send(self, operation: Operation[T]) -> T:
        try:
            response = await self._http.send(request_of(self._http, operation))
        except httpx.TransportError as error:
            raise failure_of(error, operation) from error
        return answer_of(response, operation)


async def _each(photos: Iterable[NewPhoto] | AsyncIterable[NewPhoto]) -> AsyncIterator[NewPhoto]:
    if isinstance(photos, AsyncIterable):
        async for photo in photos:
            yield photo
    else:
        for photo in photos:
            yield photo
