"""Pure functions whose results the processes of a market share, as they compute the same things.

Each process decodes the same events and recovers the signers of the same messages. The first one computes them with
the production code; the others get what it got. Only functions without side effects, whose arguments and results
can't be changed, are in the list. Errors are not kept.
"""

from __future__ import annotations

from functools import wraps
from typing import TYPE_CHECKING, Any, Final

import mesh.chain._abi
import mesh.chain._node
import mesh.chain.answers
import mesh.chain.following
import mesh.chain.rpc
import schemas.signing
from mesh.chain.answers import decode_answer

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

MOST: Final = 50_000
"""Results of a function that are kept; then it starts again."""


class Answer(dict[str, Any]):
    """A JSON-RPC response that nobody changes, with what it means once it was decoded as a type."""

    kind: Any = None
    meaning: Any = None


def install() -> None:
    """Share the results of what follows, for the rest of this process."""
    for module, name, key_of in (
        (mesh.chain._abi, "encode", _values),
        (mesh.chain._node, "decode", _words),
        (mesh.chain.answers, "checksum_address", bytes),
        (mesh.chain.following, "decode", _words),
        (schemas.signing, "checksum_address", bytes),
        (schemas.signing, "recover", _pair),
    ):
        setattr(module, name, _shared(getattr(module, name), key_of))
    setattr(mesh.chain.rpc, decode_answer.__name__, _decode_answer)


def _words(types: list[str], data: bytes) -> tuple[tuple[str, ...], bytes]:
    return tuple(types), data


def _values(types: Sequence[str], values: Sequence[Any]) -> tuple[tuple[str, ...], str]:
    return tuple(types), repr(values)


def _pair(digest: bytes, signature: str | bytes) -> tuple[bytes, str | bytes]:
    return digest, signature


def _shared(function: Callable[..., Any], key_of: Callable[..., Any]) -> Callable[..., Any]:
    known: dict[Any, Any] = {}

    @wraps(function)
    def shared(*arguments: Any) -> Any:
        key = key_of(*arguments)
        found = known.get(key)
        if found is None:
            if len(known) >= MOST:
                known.clear()
            found = known[key] = function(*arguments)
        return found

    return shared


def _decode_answer(method: str, response: object, kind: Any = Any) -> Any:
    if not isinstance(response, Answer):
        return decode_answer(method, response, kind)
    if response.meaning is None or response.kind is not kind:
        response.kind, response.meaning = kind, decode_answer(method, response, kind)
    return list(response.meaning) if isinstance(response.meaning, list) else response.meaning
