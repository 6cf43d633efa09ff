"""When to try again, and how long to wait before.

A service that is busy says so with a status and, in `Retry-After`, when to come back. It is not
asked earlier than that. Otherwise the waits double from attempt to attempt and carry jitter, so
that many clients that were turned away together do not come back together.
"""

from __future__ import annotations

import email.utils
import random
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timezone

from ._errors import ApiError, ConnectionFailed, PlaceFormerError, UnexpectedAnswer

#: Statuses that a service gives before it has begun with a request, so that sending it again
#: cannot do it twice.
_NOTHING_WAS_DONE = frozenset({408, 429, 503, 507})

#: Statuses with which a proxy says that the service behind it cannot be reached now.
_OF_PROXIES = frozenset({502, 503, 504})


@dataclass(frozen=True)
class Retry:
    """How often to try, and how long to wait in between.

    Attributes:
        attempts: Attempts in all; 1 is never to try again.
        first_wait: The wait before the second attempt, in seconds; the next ones double.
        longest_wait: The longest wait. A service that asks for a longer one is not asked again,
            but its error raised at once.

    """

    attempts: int = 5
    first_wait: float = 0.25
    longest_wait: float = 30.0

    def wait_after(
        self, error: PlaceFormerError, attempt: int, *, is_repeatable: bool
    ) -> float | None:
        """Seconds to wait after the failed `attempt` (1 is the first); `None` to give up.

        A request that is not repeatable might have been carried out although no answer came, so
        it is sent again only if the service said that it was not.
        """
        if attempt >= self.attempts or not _may_pass(error, is_repeatable=is_repeatable):
            return None
        doubled: float = self.first_wait * 2.0 ** (attempt - 1)
        wait = min(doubled, self.longest_wait) * random.uniform(0.5, 1.0)  # noqa: S311 (jitter)
        asked = error.retry_after if isinstance(error, ApiError) else None
        if asked is None:
            return wait
        return None if asked > self.longest_wait else max(wait, asked)


#: Gives up at the first failure.
NO_RETRY = Retry(attempts=1)


def _may_pass(error: PlaceFormerError, *, is_repeatable: bool) -> bool:
    if isinstance(error, ApiError):
        return error.retryable and (is_repeatable or error.status in _NOTHING_WAS_DONE)
    if isinstance(error, ConnectionFailed):
        return is_repeatable or not error.may_have_arrived
    is_of_proxy = isinstance(error, UnexpectedAnswer) and error.status in _OF_PROXIES
    return is_of_proxy and is_repeatable


def parse_retry_after(headers: Mapping[str, str]) -> float | None:
    """Seconds that the header `Retry-After` asks for, whether it has a number or a date."""
    text = headers.get("retry-after")
    if text is None:
        return None
    if text.strip().isdigit():
        return float(text)
    try:
        moment = email.utils.parsedate_to_datetime(text)
    except ValueError:
        return None
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=timezone.utc)
    return max(0.0, (moment - datetime.now(timezone.utc)).total_seconds())
