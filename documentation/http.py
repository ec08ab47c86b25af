"""The page about the interface of `aira web`, from its openapi.json."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from documentation.staging import ROOT
from schemas.decoding import decode_json

if TYPE_CHECKING:
    from collections.abc import Iterator

HEAD: Final = """\
# The page's interface

`aira web` answers these requests; the document itself is at `/api/v1/openapi.json`. {description}

Errors have a fitting status and this body, with a code of [codes.md](codes.md):
`{{"error": {{"code": …, "message": …, "hint": …}}}}`.
"""


def http_api() -> str:
    """The page's text."""
    document = decode_json((ROOT / "bridges" / "web" / "openapi.json").read_bytes())
    return "\n".join((HEAD.format(description=document["info"]["description"]), *_paths(document), *_schemas(document)))


def _paths(document: dict[str, Any]) -> Iterator[str]:
    yield "## Requests\n"
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            yield f"### {method.upper()} {path}\n"
            yield " ".join(filter(None, (f"{operation['summary']}.", operation.get("description")))) + "\n"
            queries = [given for given in operation.get("parameters", ()) if given.get("in") == "query"]
            for given in queries:
                about = given.get("description") or _type(given["schema"])
                yield f"- `{given['name']}`{' (required)' if given['required'] else ''}: {about}"
            if queries:
                yield ""
            if "requestBody" in operation:
                ((kind, content),) = operation["requestBody"]["content"].items()
                yield f"Body: {_type(content['schema'])} ({kind}).\n"
            for status, response in operation["responses"].items():
                for kind, content in response.get("content", {}).items():
                    if status.startswith("2"):
                        yield f"Answer ({status}): {_type(content['schema'])}" + (
                            ".\n" if kind == "application/json" else f" ({kind}).\n"
                        )


def _schemas(document: dict[str, Any]) -> Iterator[str]:
    yield "## Types\n"
    for name, schema in document["components"]["schemas"].items():
        yield f"### {name}\n"
        if "description" in schema:
            yield f"{schema['description']}.\n"
        if "properties" in schema:
            yield "| field | type | meaning |"
            yield "|---|---|---|"
            for field, inner in schema["properties"].items():
                optional = "" if field in schema["required"] else ", optional"
                meaning = inner.get("description", "").replace("|", "\\|")
                yield f"| `{field}` | {_type(inner)}{optional} | {meaning} |"
            yield ""
        elif "pattern" in schema:
            yield f"A text: `{schema['pattern']}`\n"


def _type(schema: dict[str, Any]) -> str:
    """A schema in a few words."""
    if "$ref" in schema:
        return str(schema["$ref"]).rpartition("/")[2]
    if "oneOf" in schema:
        return f"{_type(schema['oneOf'][0])} or null"
    if "enum" in schema:
        return " or ".join(f"`{word}`" for word in schema["enum"])
    kind = schema.get("type", "anything")
    if kind == "array":
        return f"list of {_type(schema['items'])}"
    if kind == "object" and "properties" in schema:
        return "{" + ", ".join(f"{name}: {_type(inner)}" for name, inner in schema["properties"].items()) + "}"
    if kind == "string":
        return "bytes" if schema.get("format") == "binary" else "text"
    return str(kind)
