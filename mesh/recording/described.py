"""Types of payloads with their descriptions, so that a viewer can read what was recorded."""

from __future__ import annotations

from functools import lru_cache

import msgspec

from schemas.payloads import JSON, PayloadType


@lru_cache(maxsize=1024)
def json_type(kind: type[msgspec.Struct]) -> PayloadType:
    """The type of JSON payloads that are Structs of `kind`: its name and the JSON Schema that msgspec makes of it.

    What a schema can't be made of, or is no object in JSON, is plain `JSON`.
    """
    try:
        (root,), definitions = msgspec.json.schema_components((kind,), ref_template="#/$defs/{name}")
    except TypeError:
        return JSON
    schema = definitions.get(root.get("$ref", "").rpartition("/")[2], root)
    if schema.get("type") != "object":
        return JSON
    alone = msgspec.json.encode(schema, order="sorted")
    data = msgspec.json.encode({**schema, "$defs": definitions}, order="sorted") if b'"$ref"' in alone else alone
    return PayloadType("json", kind.__name__, "jsonschema", data)
