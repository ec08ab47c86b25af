"""Schemas of JSON messages, from the messages of a topic: a schema fits all of them, and viewers can plot them."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mesh.recording import JsonSchemas, Recorder, RecordingAbout, open_objective
from mesh.recording._json_schemas import INFERENCE_LIMITS
from schemas.payloads import JSON, RAW, PayloadType, payload_type

if TYPE_CHECKING:
    from pathlib import Path

ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers(-9, 9) | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
)


def described(schemas: JsonSchemas, value: object, *, topic: str = "/arm/state", type: PayloadType = JSON) -> Any:
    return json.loads(schemas.describe(topic, json.dumps(value).encode(), type).schema_data)


def test_numbers_texts_lists_and_objects_have_a_schema() -> None:
    value = {"x": 1, "y": {"z": 1.5}, "on": True, "name": "arm", "joints": [1, 2.5], "none": None, "empty": []}
    assert described(JsonSchemas(), value) == {
        "type": "object",
        "properties": {
            "x": {"type": "number"},
            "y": {"type": "object", "properties": {"z": {"type": "number"}}},
            "on": {"type": "boolean"},
            "name": {"type": "string"},
            "joints": {"type": "array", "items": {"type": "number"}},
        },
    }


def test_the_name_is_that_of_the_type_or_of_the_topic() -> None:
    schemas = JsonSchemas()
    assert schemas.describe("/arm/state", b"{}", JSON).schema_name == "arm.state"
    assert schemas.describe("/arm/state", b"{}", payload_type("application/json;Arm")).schema_name == "Arm"


def test_a_schema_widens_to_fit_all_messages() -> None:
    schemas = JsonSchemas()
    described(schemas, {"a": 1, "b": []})
    described(schemas, {"b": ["x"], "c": None})
    both = {"a": {"type": "number"}, "b": {"type": "array", "items": {"type": "string"}}}
    assert described(schemas, {}) == {"type": "object", "properties": both}
    assert "c" not in described(schemas, {"c": 1})["properties"]
    assert described(schemas, 5) == {}


@pytest.mark.parametrize(
    "kind", [RAW, PayloadType("json", "Point", "jsonschema", b'{"type":"object","properties":{"x":{}}}')]
)
def test_other_types_and_described_ones_are_unchanged(kind: PayloadType) -> None:
    assert JsonSchemas().describe("/a", b"{}", kind) is kind


@pytest.mark.parametrize("payload", [b"no json", b"[" * 10_000, b"\xff", b'"' + b"x" * INFERENCE_LIMITS.size + b'"'])
def test_what_is_no_json_or_too_long_is_unchanged(payload: bytes) -> None:
    assert JsonSchemas().describe("/a", payload, JSON) is JSON


def test_topics_and_changes_are_limited() -> None:
    schemas = JsonSchemas()
    kinds = {
        schemas.describe("/a", json.dumps({str(number): 1}).encode(), JSON)
        for number in range(INFERENCE_LIMITS.changes + 100)
    }
    assert len(kinds) == INFERENCE_LIMITS.changes + 2
    assert JSON in kinds
    assert schemas.describe("/a", b'{"0": 2}', JSON) is not JSON
    for number in range(INFERENCE_LIMITS.topics - 1):
        assert schemas.describe(f"/b{number}", b"{}", JSON) is not JSON
    assert schemas.describe("/c", b"{}", JSON) is JSON


def fits(value: Any, schema: dict[str, Any]) -> bool:
    """Whether a schema of the kind that is made here fits a value."""
    kinds = {
        "null": value is None,
        "boolean": isinstance(value, bool),
        "number": isinstance(value, int | float) and not isinstance(value, bool),
        "string": isinstance(value, str),
        "array": isinstance(value, list) and all(fits(one, schema.get("items", {})) for one in value),
        "object": isinstance(value, dict)
        and all(fits(one, schema.get("properties", {}).get(name, {})) for name, one in value.items()),
    }
    return "type" not in schema or kinds[schema["type"]]


@pytest.mark.parametrize(
    ("first", "then", "schema"),
    [
        ({"a": 1}, {"a": 1, "b": 1}, {"a": "number", "b": "number"}),
        ({"a": {"b": 1}}, {"a": {"c": "x"}}, {"a": {"b": "number", "c": "string"}}),
        ({"a": [{"b": 1}]}, {"a": [{"b": 1}, {"c": 1}]}, {"a": [{"b": "number", "c": "number"}]}),
        ({"a": []}, {"a": [1]}, {"a": ["number"]}),
        ({"a": 1}, {"a": True}, {}),
        ({'"': 1}, {'"': 2, "b": 1}, {'"': "number", "b": "number"}),
        ({"a": [None]}, {"a": [None, 1]}, {}),
    ],
)
def test_what_a_message_adds_anywhere_is_in_the_schema(first: Any, then: Any, schema: dict[str, Any]) -> None:
    schemas = JsonSchemas()
    for _ in range(2):
        described(schemas, first)
    assert described(schemas, then) == written(schema)


def written(schema: Any) -> dict[str, Any]:
    match schema:
        case dict():
            return {"type": "object", "properties": {name: written(one) for name, one in schema.items()}}
        case [items]:
            return {"type": "array", "items": written(items)}
    return {"type": schema}


@given(st.lists(ANYTHING, min_size=1, max_size=6))
def test_the_last_schema_fits_all_messages(values: list[Any]) -> None:
    schemas = JsonSchemas()
    values = [*values, *values]
    found = [described(schemas, value) for value in values]
    assert all(fits(value, found[-1]) for value in values)
    assert all(fits(value, schema) for value, schema in zip(values, found, strict=True))


def test_a_recording_describes_what_a_device_says_and_keeps_the_type_of_what_was_played(tmp_path: Path) -> None:
    with Recorder(tmp_path / "it.mcap", RecordingAbout()) as recorder:
        recorder.record("/played", b'{"x":1}', JSON, role="objective")
        recorder.record("/wheel", b'{"x":1}', JSON)
        recorder.record("/wheel", b'{"x":2}', JSON)
    types = {topic.name: topic.type for topic in open_objective(tmp_path / "it.mcap").topics}
    schema = b'{"properties":{"x":{"type":"number"}},"type":"object"}'
    assert types == {"/played": JSON, "/wheel": PayloadType("json", "wheel", "jsonschema", schema)}
