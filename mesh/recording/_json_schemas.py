"""JSON Schemas of messages, so that viewers can plot them: from a message's type, or from the messages of a topic."""

from __future__ import annotations

from dataclasses import is_dataclass
from functools import lru_cache, reduce
from types import GenericAlias, NoneType
from typing import Annotated, Any, Final, NamedTuple

import msgspec
from msgspec import Meta

from mesh.recording import foxglove
from schemas.decoding import InvalidData, decode_json, json_check
from schemas.payloads import JSON, PayloadType, encode_value


class InferenceLimits(NamedTuple):
    """From what schemas are inferred."""

    size: int = 64 << 10
    """Bytes of a message."""
    topics: int = 1024
    """Topics that get an inferred schema."""
    changes: int = 32
    """How often the schema of a topic changes; messages that don't fit the last one get none."""
    depth: int = 8
    """How deep values are nested."""
    properties: int = 256
    """Properties of an object."""


INFERENCE_LIMITS: Final = InferenceLimits()
_KINDS: Final = {int: "integer", str: "string"}
_PYTHON_TYPES: Final = {"boolean": bool, "number": float, "string": str, "null": NoneType, None: Any}


@lru_cache(maxsize=1024)
def json_type(kind: type[Any]) -> PayloadType:
    """The payload type of `kind`, a msgspec Struct or a dataclass, as JSON: its name and its JSON Schema.

    The name is that of the class, or its `schema_name`. Plain `JSON` if `kind` has no schema, or is not an object in
    JSON.
    """
    try:
        (root,), definitions = msgspec.json.schema_components((kind,), ref_template="#/$defs/{name}")
    except TypeError:
        return JSON
    schema = _viewable(root, definitions)
    if schema is None or schema["type"] != "object":
        return JSON
    return PayloadType("json", getattr(kind, "schema_name", kind.__name__), "jsonschema", _encoded(schema))


def encode_described(value: object) -> tuple[bytes, PayloadType]:
    """As `encode_value`, with the name and schema of a Struct or dataclass in the type. Raises `InvalidPayload`."""
    payload, kind = encode_value(value)
    declared: Any = type(value)
    is_described = issubclass(declared, msgspec.Struct) or is_dataclass(declared)
    return payload, json_type(declared) if kind == JSON and is_described else kind


class JsonSchemas:
    """Describes the JSON messages of one recording whose types have no schema, by those seen on the same topic.

    A schema only ever widens, so that it matches the earlier messages, too. It names all properties seen, and requires
    none. Its name is that of the type, or of the topic.
    """

    def __init__(self) -> None:
        self._known: dict[tuple[str, str], _TopicSchema] = {}

    def describe(self, topic: str, payload: bytes, type: PayloadType) -> PayloadType:
        """The type of a message with a schema that fits; the same type if it has one already, or none is found."""
        if type.encoding != "json" or (type.schema_data and type.schema_data != JSON.schema_data):
            return type
        if type.schema_name in foxglove.KINDS:
            return json_type(foxglove.KINDS[type.schema_name])
        key = (topic, type.schema_name)
        known = self._known.get(key)
        if len(payload) > INFERENCE_LIMITS.size or (known is None and len(self._known) >= INFERENCE_LIMITS.topics):
            return type
        if known is not None and known.fits(payload):
            return known.type
        try:
            found = _schema_of(decode_json(payload))
        except InvalidData:
            return type
        if known is None:
            name = type.schema_name or topic.strip("/").replace("/", ".")
            known = self._known[key] = _TopicSchema(name, found)
        return known.type if known.widen(found) else type


class _TopicSchema:
    """What is known of the messages of a topic."""

    def __init__(self, name: str, schema: dict[str, Any]) -> None:
        self._name = name
        self._schema = schema
        self._changes = 0
        self._use()

    def widen(self, found: dict[str, Any]) -> bool:
        """Make the schema fit a message with that one. False if it has changed too often for that."""
        merged = _merged(self._schema, found)
        if merged != self._schema:
            if self._changes == INFERENCE_LIMITS.changes:
                return False
            self._changes += 1
            self._schema = merged
            self._use()
        return True

    def _use(self) -> None:
        schema = _viewable(self._schema, {}) or self._schema
        self.type = PayloadType("json", self._name, "jsonschema", _encoded(schema))
        try:
            self.fits = json_check(_python_type(self._schema))
        except ValueError:  # a property's name has quotes or control characters, which msgspec can't look for
            self.fits = _unknown


def _python_type(schema: dict[str, Any]) -> Any:
    """A type of JSON that only fits what the schema fits: looking at a message's values one by one takes ten times as
    long as decoding it.
    """
    match schema.get("type"):
        case "array":
            if "items" in schema:
                return GenericAlias(list, _python_type(schema["items"]))
            return Annotated[list[Any], Meta(max_length=0)]
        case "object":
            names = {f"f{number}": name for number, name in enumerate(schema["properties"])}
            members = [
                (field, _python_type(schema["properties"][name]) | msgspec.UnsetType, msgspec.UNSET)
                for field, name in names.items()
            ]
            return msgspec.defstruct("Message", members, rename=names, forbid_unknown_fields=True)
        case simple:
            return _PYTHON_TYPES[simple]


def _unknown(_payload: bytes) -> bool:
    return False


def _schema_of(value: Any, depth: int = INFERENCE_LIMITS.depth) -> dict[str, Any]:
    """A schema that fits JSON data; what is nested too deep fits any."""
    if not depth:
        return {}
    match value:
        case bool():
            return {"type": "boolean"}
        case int() | float():
            return {"type": "number"}
        case str():
            return {"type": "string"}
        case list() if value:
            return {"type": "array", "items": reduce(_merged, (_schema_of(one, depth - 1) for one in value))}
        case list():
            return {"type": "array"}
        case dict():
            members = list(value.items())[: INFERENCE_LIMITS.properties]
            return {"type": "object", "properties": {name: _schema_of(one, depth - 1) for name, one in members}}
    return {"type": "null"}


def _merged(one: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """A schema that fits what either fits."""
    if one == other:
        return one
    match one.get("type"), other.get("type"):
        case "object", "object":
            both = dict(one["properties"])
            for name, schema in other["properties"].items():
                if name in both:
                    both[name] = _merged(both[name], schema)
                elif len(both) < INFERENCE_LIMITS.properties:
                    both[name] = schema
            return {"type": "object", "properties": both}
        case "array", "array":
            items = [schema["items"] for schema in (one, other) if "items" in schema]
            return {"type": "array", "items": reduce(_merged, items)}
    return {}


def _viewable(schema: Any, definitions: dict[str, Any], inside: tuple[str, ...] = ()) -> dict[str, Any] | None:
    """A schema in the form that viewers read: no references, one type for each property. None if it has no such form.

    Viewers refuse a topic whose schema has another form, so a property without that form is left out: all values fit.
    """
    match schema:
        case {"$ref": str(reference)}:
            name = reference.rpartition("/")[2]
            return None if name in inside else _viewable(definitions[name], definitions, (*inside, name))
        case {"enum": [*values]}:
            kinds = {_KINDS.get(type(value), "") for value in values}
            return {**schema, "type": kinds.pop()} if kinds in ({"integer"}, {"string"}) else None
        case {"type": "object"}:
            members = (
                (name, _viewable(one, definitions, inside)) for name, one in schema.get("properties", {}).items()
            )
            found = {name: member for name, member in members if member is not None}
            kept = {name: schema[name] for name in ("title", "description", "required") if name in schema}
            return {**kept, "type": "object", "properties": found}
        case {"type": "array", "prefixItems": [first, *others]} if all(one == first for one in others):
            return _viewable({"type": "array", "items": first}, definitions, inside)
        case {"type": "array", "items": dict(items)}:
            item = _viewable(items, definitions, inside)
            is_simple = item is not None and item["type"] != "array" and "contentEncoding" not in item
            return {**schema, "items": item} if is_simple else None
        case {"type": "number" | "integer" | "string" | "boolean"}:
            return dict(schema)
    return None


def _encoded(schema: dict[str, Any]) -> bytes:
    return msgspec.json.encode(schema, order="sorted")
