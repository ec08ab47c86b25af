"""Checks answers against the schemas in openapi.json: the part of JSON Schema that it uses."""

from __future__ import annotations

import json
import re
from typing import Any, Final

from bridges.web._api import OPENAPI

DOCUMENT: Final[dict[str, Any]] = json.loads(OPENAPI.read_text())
TYPES: Final = {"object": dict, "array": list, "string": str, "boolean": bool, "null": type(None)}


def check_answer(method: str, path: str, answer: Any) -> None:
    """Raise `AssertionError` unless the answer of a route has exactly the documented form."""
    operation = next(known[method] for name, known in DOCUMENT["paths"].items() if _matches(name, path, known, method))
    (response,) = [content for status, content in operation["responses"].items() if status.startswith("2")]
    check(response["content"]["application/json"]["schema"], answer, path)


def check(schema: dict[str, Any], value: Any, place: str) -> None:
    """Raise `AssertionError` unless a value has the form of the schema."""
    if "$ref" in schema:
        check(DOCUMENT["components"]["schemas"][schema["$ref"].rpartition("/")[2]], value, place)
    elif "oneOf" in schema:
        if value is not None:
            check(schema["oneOf"][0], value, place)
    elif (kind := schema.get("type")) in TYPES:
        assert isinstance(value, TYPES[kind]), f"{place}: {value!r} is no {kind}"
        _check_parts(schema, value, place)
    elif kind is not None:
        wanted = int if kind == "integer" else (int, float)
        assert isinstance(value, wanted), f"{place}: {value!r} is no {kind}"
        assert not isinstance(value, bool), place


def _check_parts(schema: dict[str, Any], value: Any, place: str) -> None:
    match value:
        case str():
            assert re.search(schema.get("pattern", ""), value), f"{place}: {value!r}"
            assert value in schema.get("enum", [value]), f"{place}: {value!r}"
        case list():
            for number, item in enumerate(value):
                check(schema.get("items", {}), item, f"{place}[{number}]")
        case dict() if "properties" in schema:
            assert value.keys() >= set(schema["required"]), f"{place}: {set(schema['required']) - value.keys()}"
            assert value.keys() <= schema["properties"].keys(), f"{place}: {value.keys() - schema['properties'].keys()}"
            for name, item in value.items():
                check(schema["properties"][name], item, f"{place}.{name}")


def _matches(name: str, path: str, known: dict[str, Any], method: str) -> bool:
    pattern = re.sub(r"\{.*?\}", "[^/]+", name)
    return (
        method in known
        and re.fullmatch(pattern, path) is not None
        and ("{" not in name or path not in DOCUMENT["paths"])
    )
