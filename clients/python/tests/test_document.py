"""The client beside the service's OpenAPI document: names, types, options and codes."""

from __future__ import annotations

import json
import re
import types
import typing
from datetime import datetime
from typing import Any

import httpx
import msgspec
import pytest

from conftest import ROOT
from placeformer import Calibration, Info, NewReferenceOptions, QueryOptions, ReferenceFields
from placeformer import _operations as operations
from placeformer._errors import ERROR_CLASSES, Problem
from placeformer._models import OWN_FIELDS, SCHEMAS

DOCUMENT: dict[str, Any] = json.loads((ROOT / "openapi/openapi.json").read_text())
STRUCTURES: dict[Any, str] = {**SCHEMAS, Problem: "ProblemBody"}

#: The JSON type of each Python type that a field may have.
JSON_TYPES = {int: "integer", float: "number", str: "string", bool: "boolean", datetime: "string"}


def resolve(schema: dict[str, Any]) -> dict[str, Any]:
    """Follow a reference, and join what `allOf` composes."""
    if "$ref" in schema:
        name = schema["$ref"].removeprefix("#/components/schemas/")
        return resolve(DOCUMENT["components"]["schemas"][name])
    if "allOf" in schema:
        parts = [resolve(part) for part in schema["allOf"]]
        properties = {name: one for part in parts for name, one in part["properties"].items()}
        required = [name for part in parts for name in part.get("required", [])]
        return {"type": "object", "properties": properties, "required": required}
    return schema


def alternatives(schema: dict[str, Any]) -> tuple[dict[str, Any], bool]:
    """The schema of a value without null, and whether it may be null."""
    if "oneOf" in schema:
        others = [choice for choice in schema["oneOf"] if choice.get("type") != "null"]
        assert len(others) == 1, schema
        return others[0], len(others) < len(schema["oneOf"])
    if isinstance(schema.get("type"), list):
        (kind,) = (kind for kind in schema["type"] if kind != "null")
        return {**schema, "type": kind}, "null" in schema["type"]
    return schema, False


def without_none(kind: Any) -> tuple[Any, bool]:
    """The type without `None`, and whether it has that."""
    if typing.get_origin(kind) in (types.UnionType, typing.Union):
        (other,) = (one for one in typing.get_args(kind) if one is not type(None))
        return other, True
    return kind, False


def difference(kind: Any, schema: dict[str, Any]) -> str | None:
    """Say how a field's type differs from its schema, if it does."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if kind in STRUCTURES:
        name = schema.get("$ref", "").removeprefix("#/components/schemas/")
        return None if name == STRUCTURES[kind] else f"{name} is not {STRUCTURES[kind]}"
    schema = resolve(schema)
    if origin is list:
        is_array = schema["type"] == "array"
        return difference(arguments[0], schema["items"]) if is_array else "it is no array"
    if origin is tuple or hasattr(kind, "_fields"):
        count = len(arguments) or len(kind._fields)
        is_tuple = schema["type"] == "array" and schema["minItems"] == schema["maxItems"] == count
        return None if is_tuple else f"it is no array of {count}"
    if origin is dict:
        values = schema.get("additionalProperties")
        if schema["type"] != "object":
            return "it is no object"
        return difference(arguments[1], values) if isinstance(values, dict) else None
    if JSON_TYPES[kind] != schema["type"]:
        return f"{schema['type']} is not {JSON_TYPES[kind]}"
    is_moment = schema.get("format") == "date-time"
    return None if is_moment == (kind is datetime) else "only one of the two is a moment"


@pytest.mark.parametrize("structure", STRUCTURES, ids=lambda one: one.__name__)
def test_every_field_of_an_answer_is_as_the_document_says(
    structure: type[msgspec.Struct],
) -> None:
    schema = resolve(DOCUMENT["components"]["schemas"][STRUCTURES[structure]])
    hints = typing.get_type_hints(structure)
    for field in msgspec.structs.fields(structure):
        if field.name in OWN_FIELDS:
            continue
        assert field.encode_name in schema["properties"], field.name
        value, may_be_null = alternatives(schema["properties"][field.encode_name])
        kind, may_be_none = without_none(hints[field.name])
        is_optional = may_be_null or field.encode_name not in schema["required"]
        assert may_be_none == is_optional, field.name
        assert difference(kind, value) is None, (field.name, difference(kind, value))


def test_a_wrong_type_is_noticed() -> None:
    cases: list[tuple[Any, dict[str, Any]]] = [
        (int, {"type": "string"}),
        (datetime, {"type": "string"}),
        (list[int], {"type": "array", "items": {"type": "number"}}),
        (dict[str, int], {"type": "object", "additionalProperties": {"type": "string"}}),
        (Info, {"$ref": "#/components/schemas/MapBody"}),
    ]
    for kind, schema in cases:
        assert difference(kind, schema) is not None, kind


def parameters(method: str, path: str) -> set[str]:
    """The parameters of the query string of an operation."""
    named = DOCUMENT["paths"][path][method]["parameters"]
    return {one["name"] for one in named if one["in"] == "query"}


def test_every_option_is_a_parameter() -> None:
    of_references = parameters("post", "/references") - {"map"}
    assert set(NewReferenceOptions.__annotations__) <= of_references
    assert set(QueryOptions.__annotations__) <= parameters("post", "/query") - {"map"}
    changes = DOCUMENT["components"]["schemas"]["ReferenceChange"]["properties"]
    assert set(ReferenceFields.__annotations__) <= set(changes)


PNG = b"\x89PNG\r\n\x1a\n"
CALIBRATION = msgspec.json.decode(
    msgspec.json.encode(
        DOCUMENT["paths"]["/maps/{map}/calibration"]["put"]["requestBody"]["content"][
            "application/json"
        ]["example"]
    ),
    type=Calibration,
)
EVERY_OPERATION: list[operations.Operation[Any]] = [
    operations.info(),
    operations.readiness(),
    operations.maps(),
    operations.map_("m"),
    operations.delete_map("m"),
    operations.set_calibration("m", CALIBRATION),
    operations.remove_calibration("m"),
    operations.set_head("m", b"head"),
    operations.remove_head("m"),
    operations.add_reference(PNG, "m", {"lat": 1.0, "lon": 2.0}),
    operations.reference("an id"),
    operations.update_reference("an id", heading=None),
    operations.delete_reference("an id"),
    operations.list_references("m", "name", "at-1", 5),
    operations.query(PNG, "m", {"near": (1.0, 2.0), "radius_m": 5.0}),
    operations.match(PNG, PNG, None, None),
    operations.match(PNG, None, "an id", True),
]


@pytest.mark.parametrize("operation", EVERY_OPERATION, ids=lambda one: f"{one.method} {one.path}")
def test_every_operation_is_in_the_document(operation: operations.Operation[Any]) -> None:
    path = re.sub(r"^/maps/m\b", "/maps/{map}", operation.path)
    path = path.replace("/references/an%20id", "/references/{id}")
    described = DOCUMENT["paths"][path][operation.method.lower()]
    assert set(operation.params) <= {one["name"] for one in described.get("parameters", [])}
    bodies = described.get("requestBody", {}).get("content", {})
    if operation.files is not None:
        parts = bodies["multipart/form-data"]["schema"]["properties"]
        assert set(operation.files) <= set(parts)
    elif operation.content is not None:
        assert operation.headers["content-type"] in bodies
    else:
        assert not bodies
    example = next(
        (
            answer["content"]["application/json"]["example"]
            for status, answer in described["responses"].items()
            if status.startswith("2") and "content" in answer
        ),
        None,
    )
    answer = operation.read(httpx.Response(200, json=example))
    assert (answer is None) == (example is None)


def codes_of_the_document() -> set[str]:
    """Every code that some operation answers with."""
    codes: set[str] = set()
    for item in DOCUMENT["paths"].values():
        for described in item.values():
            for answer in described["responses"].values():
                problem = answer.get("content", {}).get("application/problem+json", {})
                codes.update(problem.get("examples", {}))
    return codes


def test_no_code_is_missing_and_none_is_invented() -> None:
    # What the router answers to a wrong method or path, and what no operation describes.
    of_no_operation = {"method_not_allowed", "route_not_found"}
    assert set(ERROR_CLASSES) - of_no_operation == codes_of_the_document() - of_no_operation
