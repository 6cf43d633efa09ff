"""What can be sent as an image, and what it becomes."""

from __future__ import annotations

import io
from pathlib import Path

import numpy
import pytest
from PIL import Image

from conftest import draw_facade
from facades import facade
from placeformer._images import encode


def decoded(content: bytes) -> Image.Image:
    return Image.open(io.BytesIO(content))


def test_files_and_bytes_are_sent_as_they_are(tmp_path: Path) -> None:
    content = facade(1)
    file = tmp_path / "a photo.jpg"
    file.write_bytes(content)
    for image in (content, bytearray(content), memoryview(content), file, str(file)):
        assert encode(image) == (content, "image/png")


def test_the_type_is_that_of_the_bytes() -> None:
    for name, media_type in [("JPEG", "image/jpeg"), ("WEBP", "image/webp")]:
        buffer = io.BytesIO()
        draw_facade(1).save(buffer, name)
        assert encode(buffer.getvalue()).media_type == media_type


def test_arrays_and_pillow_images_become_the_same_picture() -> None:
    picture = draw_facade(2)
    pixels = numpy.asarray(picture)
    for image in (picture, pixels, pixels[:, :, ::-1][:, :, ::-1]):
        content, media_type = encode(image)
        assert media_type == "image/jpeg"
        error = numpy.asarray(decoded(content)).astype(int) - pixels
        assert numpy.abs(error).mean() < 3
    assert decoded(encode(pixels[:, :, 0]).content).mode == "L"
    assert decoded(encode(picture.convert("RGBA")).content).mode == "RGB"


def test_the_exif_of_a_pillow_image_is_kept() -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # Orientation
    buffer = io.BytesIO()
    draw_facade(3).save(buffer, "JPEG", exif=exif)
    opened = decoded(buffer.getvalue())
    for image in (opened, opened.convert("CMYK")):
        assert decoded(encode(image).content).getexif()[0x0112] == 6


def test_what_is_no_image_is_refused_before_it_is_sent(tmp_path: Path) -> None:
    text = tmp_path / "notes.txt"
    text.write_text("no picture")
    with pytest.raises(ValueError, match=r"notes\.txt.* is no JPEG, PNG or WebP"):
        encode(text)
    with pytest.raises(ValueError, match="is empty"):
        encode(b"")
    with pytest.raises(OSError, match="nowhere"):
        encode(tmp_path / "nowhere.jpg")
    with pytest.raises(ValueError, match=r"shape \[2, 2, 4\]"):
        encode(numpy.zeros((2, 2, 4), numpy.uint8))
    with pytest.raises(ValueError, match="type <f8"):
        encode(numpy.zeros((2, 2, 3)))
    with pytest.raises(TypeError, match="int"):
        encode(7)  # type: ignore[arg-type]
