"""The options of requests.

They are parameters of the service under the same names; a test compares them with its OpenAPI
document. An option that is left out, or `None`, is left to the service.
"""

from __future__ import annotations

from datetime import datetime
from typing import Any

from typing_extensions import TypedDict


class ReferenceFields(TypedDict, total=False):
    """What a map builder says about a photo."""

    external_id: str | None
    """Your own name for the photo, unique in the map."""
    lat: float | None
    """Latitude in degrees (WGS84); with `lon` or not at all."""
    lon: float | None
    """Longitude in degrees (WGS84)."""
    heading: float | None
    """Where the camera looked, in degrees clockwise from north."""
    captured_at: datetime | None
    """When the photo was taken, with its offset from UTC."""
    metadata: dict[str, Any] | None
    """Anything else."""


class NewReferenceOptions(ReferenceFields, total=False):
    """The fields of a new reference, and whether its photo may add to them."""

    exif: bool | None
    """Whether position, heading and time may come from the photo's EXIF and XMP; they do."""
    allow_uninformative: bool | None
    """Whether a photo that shows nothing to know a place by is stored all the same."""


class QueryOptions(TypedDict, total=False):
    """Where to look, how hard, and how long."""

    top_k: int | None
    """Results wanted."""
    candidates: int | None
    """Nearest neighbours that are re-ranked."""
    rerank: bool | None
    """False: answer with the global ranking."""
    near: tuple[float, float] | None
    """Only references around this latitude and longitude; needs `radius_m`."""
    radius_m: float | None
    """Radius around `near` in metres."""
    captured_after: datetime | None
    """Only references captured at or after this time."""
    captured_before: datetime | None
    """Only references captured before this time."""
    deadline_ms: int | None
    """Milliseconds for the answer; too short for re-ranking, it is the global ranking."""
