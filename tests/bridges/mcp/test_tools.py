"""What the door says of itself: every tool is described in constant words, with the schemas of the protocol."""

from __future__ import annotations

import json

import pytest
from jsonschema import Draft202012Validator

from bridges.mcp._door import INSTRUCTIONS, TOOLS
from mesh.signer import protocol


def test_the_tools_are_the_operations_of_a_door() -> None:
    assert TOOLS.keys() == protocol.DOOR.keys() - {"answer_consent"}
    assert not TOOLS.keys() & protocol.OWNER.keys()


@pytest.mark.parametrize("name", TOOLS)
def test_a_tool_has_schemas_that_clients_read(name: str) -> None:
    tool = TOOLS[name]
    for schema in (tool.input_schema, tool.output_schema):
        Draft202012Validator.check_schema(schema)
        assert schema is not None
        assert schema["type"] == "object"
        text = json.dumps(schema)
        for reference in {part.partition('"')[0] for part in text.split('"$ref": "')[1:]}:
            assert reference.removeprefix("#/$defs/") in schema["$defs"]
    assert tool.input_schema["additionalProperties"] is False


@pytest.mark.parametrize("name", TOOLS)
def test_every_argument_is_bounded(name: str) -> None:
    def check(schema: object) -> None:
        if isinstance(schema, dict):
            kind = schema.get("type")
            if kind == "string":
                assert "maxLength" in schema or "pattern" in schema or "enum" in schema, schema
            if kind == "array":
                assert "maxItems" in schema, schema
            if kind in ("integer", "number"):
                assert "minimum" in schema, schema
            for each in schema.values():
                check(each)
        elif isinstance(schema, list):
            for each in schema:
                check(each)

    check(TOOLS[name].input_schema)


def test_the_words_are_printable_ascii() -> None:
    for words in (INSTRUCTIONS, *(tool.description or "" for tool in TOOLS.values())):
        assert all(letter == "\n" or 32 <= ord(letter) < 127 for letter in words)


def test_clients_know_which_tools_change_something() -> None:
    hints = {name: tool.annotations for name, tool in TOOLS.items()}
    acting = {name for name, hint in hints.items() if hint is not None and hint.destructive_hint}
    assert acting == {"order", "stop_job", "withdraw"}
    assert {name for name, hint in hints.items() if hint is not None and hint.read_only_hint} == TOOLS.keys() - acting
