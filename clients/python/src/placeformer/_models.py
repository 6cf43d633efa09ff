"""What the service answers, as typed structures.

Each class names the schema of the service's OpenAPI document that it stands for, in `SCHEMAS`; a
test compares the two. Fields that a newer service adds are ignored.
"""

from __future__ import annotations

from datetime import datetime
from typing import Any, Final, NamedTuple

import msgspec


class Location(msgspec.Struct, frozen=True, kw_only=True):
    """Where a photo was taken and where its camera looked, in degrees."""

    lat: float | None = None
    lon: float | None = None
    heading: float | None = None


class Reference(msgspec.Struct, frozen=True, kw_only=True):
    """A stored photo of a map: what is known of it, without its picture."""

    id: str
    map: str
    external_id: str | None = None
    location: Location | None = None
    captured_at: datetime | None = None
    metadata: dict[str, Any] | None = None
    content_sha256: str
    model: str
    created_at: datetime


class Sources(msgspec.Struct, frozen=True, kw_only=True):
    """Where the fields of a new reference come from.

    Each is `request`, the photo's own `exif` or `xmp`, `stored` where the photo was there before,
    or `None` where the field has no value.
    """

    location: str | None = None
    heading: str | None = None
    captured_at: str | None = None


class StoredReference(Reference, frozen=True, kw_only=True):
    """A reference as the answer to its upload."""

    sources: Sources
    #: Whether the upload made it; else the photo was there before under its external id. The
    #: service says so with the status of the answer.
    is_new: bool = True


class ReferencePage(msgspec.Struct, frozen=True, kw_only=True):
    """A page of a listing, and the cursor of the next one."""

    references: list[Reference]
    next: str | None = None


class ScaleScore(msgspec.Struct, frozen=True, kw_only=True):
    """Outcome of one combination of scales: mutual nearest neighbours, and inliers among them."""

    matches: int
    inliers: int


class QueryResult(msgspec.Struct, frozen=True, kw_only=True):
    """A place that the photo may show."""

    rank: int
    reference_id: str
    external_id: str | None = None
    location: Location | None = None
    global_distance: float
    spatial_score: int | None = None
    scores: dict[str, ScaleScore] | None = None
    captured_at: datetime | None = None
    metadata: dict[str, Any] | None = None


class QueryAnswer(msgspec.Struct, frozen=True, kw_only=True):
    """The ranked places, best first."""

    results: list[QueryResult]
    reranked: bool
    matched: bool | None = None
    confidence: float | None = None
    unmatched_reason: str | None = None
    timings_ms: dict[str, float]
    model: str

    @property
    def best(self) -> QueryResult | None:
        """The first place, trusted or not."""
        return self.results[0] if self.results else None


class Point(NamedTuple):
    """A position in an image of the model's input size, in pixels."""

    x: float
    y: float


class Correspondence(msgspec.Struct, frozen=True, kw_only=True):
    """Two key patches that are each other's nearest."""

    query: Point
    query_scale: int
    reference: Point
    reference_scale: int
    inlier: bool


class CombinationMatch(msgspec.Struct, frozen=True, kw_only=True):
    """One combination of scales with its evidence."""

    matches: int
    inliers: int
    #: Row-major 3x3 matrix from query pixels to reference pixels.
    homography: tuple[float, float, float, float, float, float, float, float, float] | None = None
    correspondences: list[Correspondence]


class KeyPatch(msgspec.Struct, frozen=True, kw_only=True):
    """A patch of an image that was compared; attention in multiples of an even share."""

    centre: Point
    scale: int
    attention: float


class KeyPatches(msgspec.Struct, frozen=True, kw_only=True):
    """The key patches of both images; one of scale s is s times `patch_size` pixels wide."""

    patch_size: int
    query: list[KeyPatch]
    reference: list[KeyPatch]


class Size(msgspec.Struct, frozen=True, kw_only=True):
    """Width and height in pixels."""

    width: int
    height: int


class MatchAnswer(msgspec.Struct, frozen=True, kw_only=True):
    """Correspondences and homographies of two images."""

    spatial_score: int
    combinations: dict[str, CombinationMatch]
    key_patches: KeyPatches | None = None
    input_size: Size
    timings_ms: dict[str, float]
    model: str


class ConfidenceWeights(msgspec.Struct, frozen=True, kw_only=True):
    """Weights of a confidence curve."""

    bias: float
    score: float
    distance: float


class ConfidenceCurve(msgspec.Struct, frozen=True, kw_only=True):
    """How score and distance of a best answer become a confidence, and how well that works."""

    weights: ConfidenceWeights
    threshold: float
    right: int
    wrong: int
    without_match: int
    precision: float
    recall: float
    expected_calibration_error: float


class Calibration(msgspec.Struct, frozen=True, kw_only=True, rename={"global_": "global"}):
    """What turns the best answers of one model and one re-ranking into confidences."""

    format: int
    model: str
    rerank: str
    data: str
    target_precision: float
    reranked: ConfidenceCurve
    global_: ConfidenceCurve


class Map(msgspec.Struct, frozen=True, kw_only=True):
    """A set of references that are searched together."""

    name: str
    model: str
    references: int
    created_at: datetime
    calibration: Calibration | None = None


class MapList(msgspec.Struct, frozen=True, kw_only=True):
    """All maps, by name."""

    maps: list[Map]


class MapDeleted(msgspec.Struct, frozen=True, kw_only=True):
    """What became of a map."""

    references_deleted: int


class Limits(msgspec.Struct, frozen=True, kw_only=True):
    """Bounds and defaults of requests."""

    max_image_bytes: int
    top_k: int
    candidates: int
    max_candidates: int
    deadline_ms: int
    max_metadata_bytes: int
    max_page: int


class Info(msgspec.Struct, frozen=True, kw_only=True):
    """What a server runs."""

    version: str
    model: str
    input_size: Size
    scales: list[str]
    calibration: Calibration | None = None
    limits: Limits


class IndexProgress(msgspec.Struct, frozen=True, kw_only=True):
    """How far the index is that a server builds when it starts."""

    done: int
    total: int


class Readiness(msgspec.Struct, frozen=True, kw_only=True):
    """Whether a server takes requests, or why not."""

    status: str
    progress: IndexProgress | None = None
    detail: str | None = None

    @property
    def is_ready(self) -> bool:
        """Whether it takes requests."""
        return self.status == "ready"


#: Fields that the client fills in; they are in no schema.
OWN_FIELDS: Final = frozenset({"is_new"})

#: The schema of the OpenAPI document that each class stands for.
SCHEMAS: Final[dict[type[msgspec.Struct], str]] = {
    Location: "LocationBody",
    Reference: "ReferenceBody",
    Sources: "SourcesBody",
    StoredReference: "NewReferenceBody",
    ReferencePage: "ReferencePage",
    ScaleScore: "CombinationBody",
    QueryResult: "QueryResultBody",
    QueryAnswer: "QueryAnswerBody",
    Correspondence: "CorrespondenceBody",
    CombinationMatch: "CombinationMatchBody",
    KeyPatch: "KeyPatchBody",
    KeyPatches: "KeyPatchesBody",
    Size: "SizeBody",
    MatchAnswer: "MatchAnswerBody",
    ConfidenceWeights: "ConfidenceWeights",
    ConfidenceCurve: "ConfidenceCurve",
    Calibration: "Calibration",
    Map: "MapBody",
    MapList: "MapList",
    MapDeleted: "MapDeleted",
    Limits: "LimitsBody",
    Info: "InfoBody",
    IndexProgress: "ProgressBody",
    Readiness: "ReadyBody",
}
