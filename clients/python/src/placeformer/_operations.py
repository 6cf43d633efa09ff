"""Requests and what is made of their answers, apart from how they are sent.

Sending is the only difference between the two clients. So whatever else there is to an operation
of the service is here, once: method, path, parameters, body, and the type of its answer.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Final, Generic, TypeVar
from urllib.parse import quote

import httpx
import msgspec
from typing_extensions import Unpack

from ._errors import UnexpectedAnswer
from ._images import EncodedImage, ImageInput, encode
from ._models import (
    Calibration,
    Info,
    Map,
    MapDeleted,
    MapList,
    MatchAnswer,
    QueryAnswer,
    Readiness,
    Reference,
    ReferencePage,
    StoredReference,
)
from ._options import NewReferenceOptions, QueryOptions, ReferenceFields

T = TypeVar("T")

_JSON: Final = {"content-type": "application/json"}


@dataclass(frozen=True)
class Operation(Generic[T]):
    """One request.

    Attributes:
        method: The method of HTTP.
        path: The path with its parameters filled in.
        read: Makes the answer of a response with a status of success.
        params: Parameters of the query string.
        content: The body.
        files: Parts of a multipart body, instead of `content`.
        headers: Headers that describe the body.
        is_repeatable: Whether doing it twice is the same as doing it once.
        accepted: Statuses that are answers although they are errors.

    """

    method: str
    path: str
    read: Callable[[httpx.Response], T]
    params: Mapping[str, str] = field(default_factory=dict)
    content: bytes | None = None
    files: Mapping[str, tuple[str, bytes, str]] | None = None
    headers: Mapping[str, str] = field(default_factory=dict)
    is_repeatable: bool = True
    accepted: frozenset[int] = frozenset()


def decoded(kind: type[T]) -> Callable[[httpx.Response], T]:
    """Make a reader of JSON answers of this type."""
    decoder = msgspec.json.Decoder(kind)

    def read(response: httpx.Response) -> T:
        try:
            return decoder.decode(response.content)
        except msgspec.MsgspecError as error:
            message = f"the answer is no {kind.__name__}: {error}"
            raise UnexpectedAnswer(message, status=response.status_code) from error

    return read


def _nothing(_: httpx.Response) -> None:
    """Read an answer without a body."""


_read_info = decoded(Info)
_read_map = decoded(Map)
_read_maps = decoded(MapList)
_read_map_deleted = decoded(MapDeleted)
_read_match = decoded(MatchAnswer)
_read_page = decoded(ReferencePage)
_read_query = decoded(QueryAnswer)
_read_readiness = decoded(Readiness)
_read_reference = decoded(Reference)
_read_stored = decoded(StoredReference)
_read_calibration = decoded(Calibration)


def _read_new_reference(response: httpx.Response) -> StoredReference:
    stored = _read_stored(response)
    return msgspec.structs.replace(stored, is_new=response.status_code == 201)


def info() -> Operation[Info]:
    """`GET /info`."""
    return Operation("GET", "/info", _read_info)


def readiness() -> Operation[Readiness]:
    """`GET /readyz`, whose answer says why where the status is 503."""
    return Operation("GET", "/readyz", _read_readiness, accepted=frozenset({503}))


def maps() -> Operation[list[Map]]:
    """`GET /maps`."""
    return Operation("GET", "/maps", lambda response: _read_maps(response).maps)


def map_(name: str) -> Operation[Map]:
    """`GET /maps/{map}`."""
    return Operation("GET", _map_path(name), _read_map)


def delete_map(name: str) -> Operation[MapDeleted]:
    """`DELETE /maps/{map}`."""
    return Operation("DELETE", _map_path(name), _read_map_deleted)


def set_calibration(name: str, calibration: Calibration) -> Operation[Calibration]:
    """`PUT /maps/{map}/calibration`."""
    path = f"{_map_path(name)}/calibration"
    content = msgspec.json.encode(calibration)
    return Operation("PUT", path, _read_calibration, content=content, headers=_JSON)


def remove_calibration(name: str) -> Operation[None]:
    """`DELETE /maps/{map}/calibration`."""
    return Operation("DELETE", f"{_map_path(name)}/calibration", _nothing)


def set_head(name: str, head: bytes) -> Operation[Map]:
    """`PUT /maps/{map}/head`."""
    headers = {"content-type": "application/octet-stream"}
    path = f"{_map_path(name)}/head"
    return Operation("PUT", path, _read_map, content=head, headers=headers)


def remove_head(name: str) -> Operation[Map]:
    """`DELETE /maps/{map}/head`."""
    return Operation("DELETE", f"{_map_path(name)}/head", _read_map)


def add_reference(
    image: ImageInput, map_name: str, options: NewReferenceOptions
) -> Operation[StoredReference]:
    """`POST /references`; repeatable if the photo has a name of its own."""
    encoded = encode(image)
    fields: dict[str, Any] = {"map": map_name, **options}
    return Operation(
        "POST",
        "/references",
        _read_new_reference,
        params=_query_string(fields),
        content=encoded.content,
        headers=_type_of(encoded),
        is_repeatable=fields.get("external_id") is not None,
    )


def reference(reference_id: str) -> Operation[Reference]:
    """`GET /references/{id}`."""
    return Operation("GET", _reference_path(reference_id), _read_reference)


def update_reference(
    reference_id: str, **changes: Unpack[ReferenceFields]
) -> Operation[Reference]:
    """`PATCH /references/{id}`; a field that is `None` is cleared."""
    content = msgspec.json.encode(changes)
    path = _reference_path(reference_id)
    return Operation("PATCH", path, _read_reference, content=content, headers=_JSON)


def delete_reference(reference_id: str) -> Operation[None]:
    """`DELETE /references/{id}`."""
    return Operation("DELETE", _reference_path(reference_id), _nothing)


def list_references(
    map_name: str | None,
    external_id: str | None,
    cursor: str | None,
    limit: int | None,
) -> Operation[ReferencePage]:
    """`GET /references`: one page."""
    fields = {"map": map_name, "external_id": external_id, "cursor": cursor, "limit": limit}
    return Operation("GET", "/references", _read_page, params=_query_string(fields))


def query(image: ImageInput, map_name: str, options: QueryOptions) -> Operation[QueryAnswer]:
    """`POST /query`."""
    encoded = encode(image)
    fields: dict[str, Any] = {"map": map_name, **options}
    near = fields.get("near")
    if near is not None:
        fields["near"] = f"{near[0]!r},{near[1]!r}"
    return Operation(
        "POST",
        "/query",
        _read_query,
        params=_query_string(fields),
        content=encoded.content,
        headers=_type_of(encoded),
    )


def match(
    image: ImageInput,
    reference_image: ImageInput | None,
    reference_id: str | None,
    key_patches: bool | None,
) -> Operation[MatchAnswer]:
    """`POST /match`: with a second image, or with a stored reference."""
    if (reference_image is None) == (reference_id is None):
        raise ValueError("give either a reference image or a reference_id")
    fields = {"reference_id": reference_id, "key_patches": key_patches}
    params = _query_string(fields)
    encoded = encode(image)
    if reference_image is None:
        headers = _type_of(encoded)
        content = encoded.content
        return Operation(
            "POST", "/match", _read_match, params=params, content=content, headers=headers
        )
    other = encode(reference_image)
    files = {
        "query": ("query", encoded.content, encoded.media_type),
        "reference": ("reference", other.content, other.media_type),
    }
    return Operation("POST", "/match", _read_match, params=params, files=files)


def _map_path(name: str) -> str:
    return f"/maps/{quote(name, safe='')}"


def _reference_path(reference_id: str) -> str:
    return f"/references/{quote(reference_id, safe='')}"


def _type_of(image: EncodedImage) -> dict[str, str]:
    return {"content-type": image.media_type}


def _query_string(fields: Mapping[str, Any]) -> dict[str, str]:
    """The fields that have a value, as text."""
    given = {name: value for name, value in fields.items() if value is not None}
    return {name: _text_of(name, value) for name, value in given.items()}


def _text_of(name: str, value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, datetime):
        if value.tzinfo is None:
            raise ValueError(f"{name} has no offset from UTC, so that it names no moment")
        return value.isoformat()
    if isinstance(value, dict):
        return json.dumps(value)
    return str(value)
