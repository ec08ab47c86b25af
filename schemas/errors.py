"""The root of all errors of AIRA mesh, and the errors of invalid input.

`AiraError` is the base of every error that the project raises on purpose. Errors of configuration, network, chain and
content are in `mesh.errors`.
"""

from __future__ import annotations

from typing import Any


class AiraError(Exception):
    """An error that a person can act on.

    `str(error)` is one clear line; `hint` says what to do about it (one sentence, or empty). `code` is a stable name
    for programs, which stays the same when the sentences change.
    """

    code: str = "error"

    def __init_subclass__(cls, *, code: str = "", **options: Any) -> None:
        """A class has a code of its own: `class FeeTooHigh(ChainError, code="fee-too-high")`.

        An error that nobody catches apart from others of its class has its code without a class of its own:
        `ConfigurationError("…", code="files-missing")`.
        """
        super().__init_subclass__(**options)
        if code:
            cls.code = code

    def __init__(self, message: str, *, hint: str = "", code: str = "") -> None:
        super().__init__(message)
        self.hint = hint
        if code:
            self.code = code


class InputError(AiraError, ValueError, code="input-error"):
    """The input is wrong: a message, a key, a name, a file. Trying again does not help."""


class InvalidAddress(InputError, code="invalid-address"):
    """A text is not an Ethereum address, or it is in mixed case with a wrong EIP-55 checksum."""

    def __init__(self, text: str, why: str) -> None:
        super().__init__(f"{text[:80]!r} is not an address: {why}")
        self.text = text
        self.why = why


class InvalidCid(InputError, code="invalid-cid"):
    """A text or bytes are not a CIDv0 (base58 of a 34-byte sha2-256 multihash), or not the block that a CID names."""

    def __init__(self, text: str, why: str) -> None:
        super().__init__(f"{text[:80]!r} is not a CIDv0: {why}")
        self.text = text


class InvalidKey(InputError, code="invalid-key"):
    """A key is outside the keyspace, or a text can't be part of a key."""

    def __init__(self, text: str, why: str) -> None:
        super().__init__(f"{text[:160]!r} is not a key of the mesh: {why}")
        self.text = text
        self.why = why


class InvalidMessage(InputError, code="invalid-message"):
    """A message is not valid.

    `reason` is a short word for programs, by which channels count such messages (`not-json`, `field`, `signature`, …);
    `detail` is for people.
    """

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"invalid message ({reason}): {detail}")
        self.reason = reason
        self.detail = detail


class InvalidRecord(InputError, code="invalid-record"):
    """A request, a reply or a liability record is not valid."""

    def __init__(self, kind: str, why: str) -> None:
        super().__init__(f"not a {kind}: {why}")
        self.kind = kind
        self.why = why


class InvalidPayload(InputError, code="invalid-payload"):
    """The payload of a topic is not of its type."""

    def __init__(self, type_name: str, why: str) -> None:
        super().__init__(f"not a {type_name}: {why}")
        self.type_name = type_name
