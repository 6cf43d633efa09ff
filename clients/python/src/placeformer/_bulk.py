"""Many photos at once: a bounded number of requests under way, and a verdict for each photo.

Photos are read only when it is their turn, and verdicts come in the order of the photos. So an
ingest of any length takes the same memory, and can go on where it stopped.
"""

from __future__ import annotations

import time
from collections.abc import AsyncIterable, Callable, Iterable, Sized
from dataclasses import dataclass, field, replace
from typing import Final, Literal

from ._errors import Conflict, ImageRefused, InvalidRequest
from ._images import ImageInput
from ._models import StoredReference
from ._options import NewReferenceOptions


@dataclass(frozen=True)
class NewPhoto:
    """A photo to be stored: the image, and what is known of it.

    Give each an `external_id`. Then a photo can be sent again when no answer came, and an
    interrupted ingest can be repeated, without its being stored twice.
    """

    image: ImageInput
    fields: NewReferenceOptions = field(default_factory=NewReferenceOptions)


@dataclass(frozen=True)
class Verdict:
    """What became of a photo.

    Attributes:
        photo: The photo.
        outcome: `added`, `present` (it was there before) or `refused`.
        reference: The stored reference, unless it was refused.
        error: Why it was refused.

    """

    photo: NewPhoto
    outcome: Literal["added", "present", "refused"]
    reference: StoredReference | None = None
    error: Exception | None = None


@dataclass
class Progress:
    """How far an ingest is.

    Attributes:
        total: Photos in all, where that is known.
        added: Photos that are new.
        present: Photos that were there before.
        refused: Photos that were refused.
        seconds: Time since the start.

    """

    total: int | None
    added: int = 0
    present: int = 0
    refused: int = 0
    seconds: float = 0.0

    @property
    def done(self) -> int:
        """Photos that have a verdict."""
        return self.added + self.present + self.refused

    @property
    def photos_per_second(self) -> float:
        """The average rate so far."""
        return self.done / self.seconds if self.seconds > 0 else 0.0


#: Is called after each verdict.
ProgressCallback = Callable[[Progress], None]

#: What is wrong with one photo: it cannot be read, it is no image, or the service refuses it. All
#: other errors, such as a wrong key, would come again with every further photo, so they end the
#: ingest.
OF_ONE_PHOTO: Final = (OSError, ValueError, ImageRefused, InvalidRequest, Conflict)


class Counter:
    """Counts verdicts and reports them."""

    def __init__(
        self,
        photos: Iterable[NewPhoto] | AsyncIterable[NewPhoto],
        callback: ProgressCallback | None,
    ) -> None:
        self._progress = Progress(total=len(photos) if isinstance(photos, Sized) else None)
        self._callback = callback
        self._started = time.monotonic()

    def count(self, verdict: Verdict) -> Verdict:
        """Count a verdict, report it, and hand it back."""
        progress = self._progress
        setattr(progress, verdict.outcome, getattr(progress, verdict.outcome) + 1)
        progress.seconds = time.monotonic() - self._started
        if self._callback is not None:
            self._callback(replace(progress))
        return verdict


def stored(photo: NewPhoto, reference: StoredReference) -> Verdict:
    """Make the verdict of a photo that is stored."""
    return Verdict(photo, "added" if reference.is_new else "present", reference=reference)


def refused(photo: NewPhoto, error: Exception) -> Verdict:
    """Make the verdict of a photo that is not stored.

    Raises:
        Conflict: The error itself, if it is about the map and not about the photo.

    """
    if isinstance(error, Conflict) and error.code == "model_mismatch":
        raise error
    return Verdict(photo, "refused", error=error)
