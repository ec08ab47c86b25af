"""The errors of AIRA mesh, by whose fault they are.

`AiraError` is the root of every error that the project raises on purpose. The branches here are those of what
travels; the branches of what runs (configuration, network, chain, content) are in `mesh.errors`.
"""

from __future__ import annotations

from typing import ClassVar


class AiraError(Exception):
    """Anything that went wrong and that a person can act on.

    `str(error)` is one clear line; `hint` says what to do about it (one sentence, or empty). `code` is a stable word
    for programs: it stays when the sentences change.
    """

    code: ClassVar[str] = "error"

    def __init__(self, message: str, *, hint: str = "") -> None:
        super().__init__(message)
        self.hint = hint


class InputError(AiraError, ValueError):
    """What was given is wrong: a message, a key, a name, a file. Giving it again changes nothing."""

    code = "input-error"


class InvalidAddress(InputError):
    """A text is no Ethereum address, or a mixed-case one whose EIP-55 checksum does not hold."""

    code = "invalid-address"

    def __init__(self, text: str, why: str) -> None:
        super().__init__(f"{text[:80]!r} is not an address: {why}")
        self.text = text


class InvalidCid(InputError):
    """A text or some bytes are no CIDv0 (base58 of a 34-byte sha2-256 multihash), or no block that such a CID names."""

    code = "invalid-cid"

    def __init__(self, text: str, why: str) -> None:
        super().__init__(f"{text[:80]!r} is not a CIDv0: {why}")
        self.text = text


class InvalidKey(InputError):
    """A key is outside the keyspace, or would have to be built from text that no key may hold."""

    code = "invalid-key"

    def __init__(self, text: str, why: str) -> None:
        super().__init__(f"{text[:160]!r} is not a key of the mesh: {why}")
        self.text = text


class InvalidMessage(InputError):
    """A message can't be what it claims to be.

    `reason` is a short machine-readable word, the label under which a channel counts it (`not-json`, `field`,
    `signature`, …); `detail` is for people.
    """

    code = "invalid-message"

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"invalid message ({reason}): {detail}")
        self.reason = reason
        self.detail = detail


class InvalidRecord(InputError):
    """A request, a reply or a liability record is not what it should be."""

    code = "invalid-record"

    def __init__(self, kind: str, why: str) -> None:
        super().__init__(f"not a {kind}: {why}")
        self.kind = kind


class InvalidPayload(InputError):
    """The payload of a topic can't be read as the type it should have."""

    code = "invalid-payload"

    def __init__(self, type_name: str, why: str) -> None:
        super().__init__(f"not a {type_name}: {why}")
        self.type_name = type_name
