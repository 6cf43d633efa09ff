"""Images in whatever form a program has them, as the bytes that the service takes.

Files and bytes are sent as they are, so that their EXIF arrives. Arrays and Pillow images are
encoded first, which needs Pillow (`pip install placeformer[images]`).
"""

from __future__ import annotations

import io
import os
import sys
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Any,
    Final,
    NamedTuple,
    Protocol,
    Union,
    cast,
    runtime_checkable,
)

if TYPE_CHECKING:
    import PIL.Image


@runtime_checkable
class SupportsArrayInterface(Protocol):
    """A numpy array, or what offers its memory in the same way."""

    @property
    def __array_interface__(self) -> dict[str, Any]:
        """The description of the memory."""


#: A photo: the path of its file, the bytes of one, an array `[height, width, 3]` (RGB) or
#: `[height, width]` (grey) of `uint8`, or a Pillow image. OpenCV's arrays are BGR: turn them with
#: `array[..., ::-1]`.
ImageInput = Union[
    str,
    "os.PathLike[str]",
    bytes,
    bytearray,
    memoryview,
    SupportsArrayInterface,
    "PIL.Image.Image",
]

#: Quality of the JPEGs that arrays and Pillow images become, from 1 to 100. At 92, a photo has a
#: tenth of the bytes of a PNG, and the descriptors hardly differ.
JPEG_QUALITY: Final = 92


class EncodedImage(NamedTuple):
    """The bytes of an image, and their media type."""

    content: bytes
    media_type: str


def encode(image: ImageInput) -> EncodedImage:
    """Read or encode an image.

    Raises:
        ValueError: The bytes are no JPEG, PNG or WebP, or the array has another shape or type.
        TypeError: It is something else.
        OSError: The file cannot be read.

    """
    if isinstance(image, (str, os.PathLike)):
        return _recognised(Path(image).read_bytes(), f"the file {os.fspath(image)!r}")
    if isinstance(image, (bytes, bytearray, memoryview)):
        return _recognised(bytes(image), "the image")
    # A Pillow image can only come from a program that has imported Pillow.
    pillow = sys.modules.get("PIL.Image")
    if pillow is not None and isinstance(image, pillow.Image):
        return _encoded(image)
    if isinstance(image, SupportsArrayInterface):
        return _encoded(_image_of_array(image))
    raise TypeError(f"an image is a path, bytes, an array or a Pillow image, not {type(image)}")


def _recognised(content: bytes, name: str) -> EncodedImage:
    """Find the media type by the first bytes, since names lie."""
    if content.startswith(b"\xff\xd8\xff"):
        return EncodedImage(content, "image/jpeg")
    if content.startswith(b"\x89PNG\r\n\x1a\n"):
        return EncodedImage(content, "image/png")
    if content.startswith(b"RIFF") and content[8:12] == b"WEBP":
        return EncodedImage(content, "image/webp")
    what = "is empty" if not content else "is no JPEG, PNG or WebP"
    raise ValueError(f"{name} {what}")


def _image_of_array(array: SupportsArrayInterface) -> PIL.Image.Image:
    interface = array.__array_interface__
    shape, kind = interface["shape"], interface["typestr"]
    is_picture = len(shape) == 2 or (len(shape) == 3 and shape[2] == 3)
    if not is_picture or kind != "|u1":
        expected = "[height, width, 3] or [height, width] of uint8"
        raise ValueError(f"an array of shape {list(shape)} and type {kind} is not {expected}")
    try:
        import PIL.Image  # noqa: PLC0415 (an optional dependency)
    except ImportError as error:
        message = "arrays are encoded with Pillow: pip install placeformer[images]"
        raise TypeError(message) from error
    # What Pillow demands of the type differs between versions; what it needs was checked above.
    return PIL.Image.fromarray(cast("Any", array))


def _encoded(image: PIL.Image.Image) -> EncodedImage:
    """Encode as JPEG with all its colours, and with the EXIF that the image came with."""
    if image.mode not in ("RGB", "L"):
        exif = image.info.get("exif")
        image = image.convert("RGB")
    else:
        exif = image.info.get("exif")
    options = {"exif": exif} if exif else {}
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=JPEG_QUALITY, subsampling=0, **options)
    return EncodedImage(buffer.getvalue(), "image/jpeg")
