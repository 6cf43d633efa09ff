"""What both clients do around sending: the settings of the connection, and reading an answer."""

from __future__ import annotations

import os
import ssl
from typing import Any, TypeVar

import httpx

from ._errors import ConnectionFailed, error_of
from ._operations import Operation
from ._retry import parse_retry_after

T = TypeVar("T")


def connection_settings(
    url: str, api_key: str | None, timeout: float, ca_cert: str | os.PathLike[str] | None
) -> dict[str, Any]:
    """The arguments of an httpx client for this service.

    Raises:
        ValueError: The address is no `http://` or `https://` URL.
        OSError: The certificate cannot be read.

    """
    base = httpx.URL(url)
    if base.scheme not in ("http", "https") or not base.host:
        raise ValueError(f"{url!r} is no address of a service, such as http://127.0.0.1:8080")
    headers = {"user-agent": "placeformer-python"}
    if api_key is not None:
        headers["authorization"] = f"Bearer {api_key}"
    settings: dict[str, Any] = {"base_url": base, "headers": headers, "timeout": timeout}
    if ca_cert is not None:
        settings["verify"] = ssl.create_default_context(cafile=os.fspath(ca_cert))
    return settings


def request_of(http: httpx.Client | httpx.AsyncClient, operation: Operation[T]) -> httpx.Request:
    """The request that an operation sends."""
    return http.build_request(
        operation.method,
        operation.path,
        params=dict(operation.params),
        content=operation.content,
        files=None if operation.files is None else dict(operation.files),
        headers=dict(operation.headers),
    )


def answer_of(response: httpx.Response, operation: Operation[T]) -> T:
    """The answer to an operation.

    Raises:
        ApiError: The service refused it.
        UnexpectedAnswer: The response is not the service's.

    """
    if response.is_success or response.status_code in operation.accepted:
        return operation.read(response)
    raise error_of(response, parse_retry_after(response.headers))


def failure_of(error: httpx.TransportError, operation: Operation[T]) -> ConnectionFailed:
    """The error of a request that got no answer."""
    never_left = (httpx.ConnectError, httpx.ConnectTimeout, httpx.PoolTimeout)
    cause = str(error) or type(error).__name__
    return ConnectionFailed(
        f"{operation.method} {operation.path}: {cause}",
        may_have_arrived=not isinstance(error, never_left),
    )
