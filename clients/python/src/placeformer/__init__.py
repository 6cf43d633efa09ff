"""Client of PlaceFormer, a visual place recognition service.

    from placeformer import Client

    with Client("http://127.0.0.1:8080") as client:
        client.add_reference("harbour.jpg", "town", external_id="harbour", lat=51.5, lon=-0.12)
        answer = client.query("frame.jpg", "town", top_k=3)
        if answer.matched:
            print(answer.best)

`AsyncClient` has the same methods for asyncio.

How it is built: `_operations` has every operation of the service, apart from how it is sent;
`_client` and `_async_client` send them; `_models` are the answers, `_errors` the exceptions,
`_images` what can be sent as an image, `_retry` when to try again, and `_bulk` the ingest of many
photos. A further operation is a function in `_operations` and a method in each client.
"""

from ._async_client import AsyncClient
from ._bulk import NewPhoto, Progress, Verdict
from ._client import Client
from ._errors import (
    ApiError,
    Conflict,
    ConnectionFailed,
    ImageRefused,
    InvalidRequest,
    NotAuthorised,
    NotFound,
    PlaceFormerError,
    ServerFault,
    Unavailable,
    UnexpectedAnswer,
)
from ._images import ImageInput
from ._models import (
    Calibration,
    CombinationMatch,
    ConfidenceCurve,
    ConfidenceWeights,
    Correspondence,
    IndexProgress,
    Info,
    KeyPatch,
    KeyPatches,
    Limits,
    Location,
    Map,
    MapDeleted,
    MatchAnswer,
    Point,
    QueryAnswer,
    QueryResult,
    Readiness,
    Reference,
    ScaleScore,
    Size,
    Sources,
    StoredReference,
)
from ._options import NewReferenceOptions, QueryOptions, ReferenceFields
from ._retry import NO_RETRY, Retry

__all__ = [
    "NO_RETRY",
    "ApiError",
    "AsyncClient",
    "Calibration",
    "Client",
    "CombinationMatch",
    "ConfidenceCurve",
    "ConfidenceWeights",
    "Conflict",
    "ConnectionFailed",
    "Correspondence",
    "ImageInput",
    "ImageRefused",
    "IndexProgress",
    "Info",
    "InvalidRequest",
    "KeyPatch",
    "KeyPatches",
    "Limits",
    "Location",
    "Map",
    "MapDeleted",
    "MatchAnswer",
    "NewPhoto",
    "NewReferenceOptions",
    "NotAuthorised",
    "NotFound",
    "PlaceFormerError",
    "Point",
    "Progress",
    "QueryAnswer",
    "QueryOptions",
    "QueryResult",
    "Readiness",
    "Reference",
    "ReferenceFields",
    "Retry",
    "ScaleScore",
    "ServerFault",
    "Size",
    "Sources",
    "StoredReference",
    "Unavailable",
    "UnexpectedAnswer",
    "Verdict",
]
