"""Gives two thirds of the well-formed requests a real photo, map and reference, so that they get beyond validation.

The document can say that a body is an image, but not what makes bytes one; and no generator guesses an id. A deadline
is taken out: how long a photo takes is the machine's affair, and an answer that comes too late is a 504 by right.
"""

import base64
import os
import zlib

import schemathesis
from schemathesis import GenerationMode

with open(os.environ["PHOTO"], "rb") as file:
    PHOTO = file.read()
PHOTO_TEXT = base64.b64encode(PHOTO).decode()
MAP, REFERENCE = os.environ["MAP"], os.environ["REFERENCE"]


def with_photo(body, media_type):
    if media_type.startswith("image/") or media_type == "application/octet-stream":
        return PHOTO
    if isinstance(body, dict):
        photo = PHOTO if media_type.startswith("multipart/") else PHOTO_TEXT
        return {name: photo if name in ("image", "query", "reference") else value for name, value in body.items()}
    return body


def well_formed(meta):
    modes = [meta.generation.mode, *(component.mode for component in meta.components.values())]
    return all(mode is GenerationMode.POSITIVE for mode in modes)


@schemathesis.hook
def before_call(context, case, kwargs):
    if case.meta is None or not well_formed(case.meta) or zlib.crc32(case.id.encode()) % 3 == 0:
        return
    if case.media_type:
        case.body = with_photo(case.body, case.media_type)
    for values in (case.query, case.body):
        if isinstance(values, dict):
            values.pop("deadline_ms", None)
    if case.method.upper() != "DELETE":
        for values, known in ((case.path_parameters, {"id": REFERENCE, "map": MAP}), (case.query, {"map": MAP})):
            values.update({name: value for name, value in known.items() if name in values})
