"""Everything that can go wrong, as exceptions.

A program that asks a service needs to tell three things apart: the service refused the request (an
`ApiError`, whose class says what to do about it and whose code says why), the service could not be
reached (`ConnectionFailed`), or what came back is not what the service says (`UnexpectedAnswer`).
"""

from __future__ import annotations

from typing import Final

import httpx
import msgspec


class PlaceFormerError(Exception):
    """The base of all errors of this package, except wrong arguments, which are `ValueError`."""


class ConnectionFailed(PlaceFormerError):
    """No answer arrived: the service is unreachable, or the time was up.

    Attributes:
        may_have_arrived: Whether the service might have got the request all the same.

    """

    def __init__(self, message: str, *, may_have_arrived: bool) -> None:
        super().__init__(message)
        self.may_have_arrived = may_have_arrived


class UnexpectedAnswer(PlaceFormerError):
    """An answer arrived that is not the service's, or that this version does not understand.

    Attributes:
        status: The HTTP status.

    """

    def __init__(self, message: str, *, status: int) -> None:
        super().__init__(message)
        self.status = status


class Problem(msgspec.Struct, frozen=True, kw_only=True):
    """What the service says of an error (RFC 9457, schema `ProblemBody`)."""

    type: str
    title: str
    status: int
    code: str
    detail: str
    request_id: str
    retryable: bool


class ApiError(PlaceFormerError):
    """The service refused the request.

    Attributes:
        code: The stable name of the cause, such as `map_not_found`.
        status: The HTTP status.
        title: The code in words.
        detail: What exactly is wrong with this request.
        request_id: The request's id, under which the service's log has it.
        retryable: Whether the same request may succeed later.
        retry_after: Seconds after which to try again, where the service says so.

    """

    def __init__(self, problem: Problem, retry_after: float | None = None) -> None:
        super().__init__(f"{problem.code}: {problem.detail} (request {problem.request_id})")
        self.code = problem.code
        self.status = problem.status
        self.title = problem.title
        self.detail = problem.detail
        self.request_id = problem.request_id
        self.retryable = problem.retryable
        self.retry_after = retry_after


class InvalidRequest(ApiError):
    """The request cannot be answered as it is: a parameter, a type or a size is wrong."""


class ImageRefused(ApiError):
    """The image is empty, too large, of an unknown type, damaged, or shows nothing."""


class NotAuthorised(ApiError):
    """The key is missing or wrong, or does not allow this."""


class NotFound(ApiError):
    """There is no such map, reference or path."""


class Conflict(ApiError):
    """What is stored contradicts the request: another photo, another model."""


class Unavailable(ApiError):
    """The service cannot do this now: it is busy, starting, stopping, full or out of time."""


class ServerFault(ApiError):
    """The service failed."""


#: The class of each code that the service answers with.
ERROR_CLASSES: Final[dict[str, type[ApiError]]] = {
    "malformed_request": InvalidRequest,
    "invalid_parameter": InvalidRequest,
    "method_not_allowed": InvalidRequest,
    "body_too_large": InvalidRequest,
    "head_unreadable": InvalidRequest,
    "empty_image": ImageRefused,
    "image_too_large": ImageRefused,
    "image_undecodable": ImageRefused,
    "image_uninformative": ImageRefused,
    "track_malformed": InvalidRequest,
    "track_forged": InvalidRequest,
    "track_expired": InvalidRequest,
    "track_other_map": InvalidRequest,
    "track_other_model": InvalidRequest,
    "unsupported_media_type": ImageRefused,
    "unauthorized": NotAuthorised,
    "forbidden": NotAuthorised,
    "host_not_allowed": NotAuthorised,
    "cross_origin": NotAuthorised,
    "route_not_found": NotFound,
    "map_not_found": NotFound,
    "reference_not_found": NotFound,
    "external_id_conflict": Conflict,
    "model_mismatch": Conflict,
    "calibration_mismatch": Conflict,
    "head_mismatch": Conflict,
    "track_unavailable": Conflict,
    "request_timeout": Unavailable,
    "rate_limited": Unavailable,
    "overloaded": Unavailable,
    "not_ready": Unavailable,
    "shutting_down": Unavailable,
    "memory_pressure": Unavailable,
    "deadline_exceeded": Unavailable,
    "disk_full": Unavailable,
    "storage_lost": Unavailable,
    "corrupt_record": ServerFault,
    "internal": ServerFault,
}

_PROBLEM_DECODER = msgspec.json.Decoder(Problem)


def error_of(response: httpx.Response, retry_after: float | None) -> PlaceFormerError:
    """The exception for an answer whose status is an error.

    A newer service may have codes that are not in the table; they become an `ApiError` itself.
    What is no problem document was not written by the service: a proxy in between answers so.
    """
    try:
        problem = _PROBLEM_DECODER.decode(response.content)
    except msgspec.MsgspecError:
        status, start = response.status_code, response.text[:200]
        return UnexpectedAnswer(f"status {status}, which is no problem: {start!r}", status=status)
    return ERROR_CLASSES.get(problem.code, ApiError)(problem, retry_after)
