"""The client that waits for each answer."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
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


class Client:
    """A client of one service; threads may share it.

    Every method raises `ApiError` if the service refuses the request, `ConnectionFailed` if there
    is no answer, and `UnexpectedAnswer` if there is another one than the service gives.

    Args:
        url: Where the service is, such as `http://127.0.0.1:8080`.
        api_key: The key, if the service has keys.
        timeout: Seconds that connecting, sending or receiving may pause.
        retry: How often to try again what may pass.
        ca_cert: A certificate to trust, as a PEM file, beside none of the usual ones.
        transport: Sends requests in another way than over the network.

    """

    def __init__(
        self,
        url: str,
        *,
        api_key: str | None = None,
        timeout: float = 60.0,
        retry: Retry | None = None,
        ca_cert: str | os.PathLike[str] | None = None,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        settings = connection_settings(url, api_key, timeout, ca_cert)
        self._http = httpx.Client(transport=transport, **settings)
        self._retry = Retry() if retry is None else retry

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def info(self) -> Info:
        """Tell what the server runs, and the bounds of requests."""
        return self._run(operations.info())

    def readiness(self) -> Readiness:
        """Tell whether the server takes requests, or why not."""
        return self._run(operations.readiness())

    def query(self, image: ImageInput, map: str, **options: Unpack[QueryOptions]) -> QueryAnswer:  # noqa: A002
        """Find the places that a photo may show, best first."""
        return self._run(operations.query(image, map, options))

    def match(
        self,
        image: ImageInput,
        reference: ImageInput | None = None,
        *,
        reference_id: str | None = None,
        key_patches: bool | None = None,
    ) -> MatchAnswer:
        """Compare a photo with another one, or with a stored reference, and show the evidence."""
        return self._run(operations.match(image, reference, reference_id, key_patches))

    def add_reference(
        self,
        image: ImageInput,
        map: str,  # noqa: A002
        **fields: Unpack[NewReferenceOptions],
    ) -> StoredReference:
        """Store a photo in a map, which is created on first use.

        Without an `external_id`, a photo whose answer got lost is not sent again, because it might
        then be stored twice.
        """
        return self._run(operations.add_reference(image, map, fields))

    def ingest(
        self,
        photos: Iterable[NewPhoto],
        map: str,  # noqa: A002
        *,
        workers: int = 4,
        progress: ProgressCallback | None = None,
    ) -> Generator[Verdict, None, None]:
        """Store many photos in a map, and give a verdict for each, in their order.

        The photos are sent while the verdicts are taken; whoever stops taking them stops the
        ingest. What is wrong with one photo is its verdict. Errors that concern all photos, such
        as a wrong key, are raised.

        Args:
            photos: The photos; they may be made one by one.
            map: The map.
            workers: Requests under way at once.
            progress: Is called after each verdict.

        """
        counter = Counter(photos, progress)
        pending: deque[Future[Verdict]] = deque()
        with ThreadPoolExecutor(workers, thread_name_prefix="placeformer") as pool:
            try:
                for photo in photos:
                    pending.append(pool.submit(self._store, photo, map))
                    if len(pending) >= 2 * workers:
                        yield counter.count(pending.popleft().result())
                while pending:
                    yield counter.count(pending.popleft().result())
            finally:
                for future in pending:
                    future.cancel()

    def reference(self, reference_id: str) -> Reference:
        """Show a stored reference."""
        return self._run(operations.reference(reference_id))

    def references(
        self,
        map: str | None = None,  # noqa: A002
        *,
        external_id: str | None = None,
        page_size: int | None = None,
    ) -> Iterator[Reference]:
        """List references, of a map or of all, in the order they were added."""
        cursor = None
        while True:
            operation = operations.list_references(map, external_id, cursor, page_size)
            page = self._run(operation)
            yield from page.references
            cursor = page.next
            if cursor is None:
                return

    def update_reference(self, reference_id: str, **changes: Unpack[ReferenceFields]) -> Reference:
        """Change the fields that are given; `None` clears one."""
        return self._run(operations.update_reference(reference_id, **changes))

    def delete_reference(self, reference_id: str) -> None:
        """Delete a reference."""
        self._run(operations.delete_reference(reference_id))

    def maps(self) -> list[Map]:
        """List all maps by name."""
        return self._run(operations.maps())

    def map(self, name: str) -> Map:
        """Show a map."""
        return self._run(operations.map_(name))

    def delete_map(self, name: str) -> MapDeleted:
        """Delete a map with all its references."""
        return self._run(operations.delete_map(name))

    def set_calibration(self, name: str, calibration: Calibration) -> Calibration:
        """Calibrate a map."""
        return self._run(operations.set_calibration(name, calibration))

    def remove_calibration(self, name: str) -> None:
        """Remove a map's calibration."""
        self._run(operations.remove_calibration(name))

    def set_head(self, name: str, head: str | os.PathLike[str]) -> Map:
        """Give a map the head in this safetensors file."""
        return self._run(operations.set_head(name, Path(head).read_bytes()))

    def remove_head(self, name: str) -> Map:
        """Give a map the server's head."""
        return self._run(operations.remove_head(name))

    def _store(self, photo: NewPhoto, map_name: str) -> Verdict:
        try:
            operation = operations.add_reference(photo.image, map_name, photo.fields)
            return stored(photo, self._run(operation))
        except OF_ONE_PHOTO as error:
            return refused(photo, error)

    def _run(self, operation: Operation[T]) -> T:
        """Carry out an operation, as often as the policy allows."""
        attempt = 1
        while True:
            try:
                return self._send(operation)
            except PlaceFormerError as error:
                repeatable = operation.is_repeatable
                wait = self._retry.wait_after(error, attempt, is_repeatable=repeatable)
                if wait is None:
                    raise
            time.sleep(wait)
            attempt += 1

    def _send(self, operation: Operation[T]) -> T:
        try:
            response = self._http.send(request_of(self._http, operation))
        except httpx.TransportError as error:
            raise failure_of(error, operation) from error
        return answer_of(response, operation)
