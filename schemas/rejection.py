"""A provider's word that an order or a Result can't be used, and why; put on `aira/{lighthouse}/reject/…`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Self

from msgspec.structs import replace

from schemas.errors import InvalidMessage
from schemas.keccak import keccak256
from schemas.records import Record
from schemas.signing import recover

if TYPE_CHECKING:
    from schemas.signing import Signer

_DOMAIN: Final = b"aira rejection\0"
"""What is signed here is nothing else: no message of the market begins like this."""


class Rejection(Record, frozen=True, kw_only=True):
    """Why a provider will not use a message.

    `order` is the message's hash (64 hexadecimal digits), `reason` a machine-readable word (a refusal of the order
    book, or the name of the contracts' error), `detail` is for people, `provider` the EIP-55 address of who says so,
    `signature` (130 hexadecimal digits) that account's. Anybody may write one: believe what `is_signed`, of a provider
    of the lighthouse.
    """

    order: str
    reason: str
    detail: str
    provider: str
    signature: str = ""

    def signed_by(self, signer: Signer) -> Self:
        """The same with the signature of `signer`, whose address `provider` has to be."""
        return replace(self, signature=signer.sign_hash(self._hash()).hex())

    @property
    def is_signed(self) -> bool:
        """Whether the signature is the provider's."""
        try:
            return recover(self._hash(), self.signature) == self.provider
        except InvalidMessage:
            return False

    def _hash(self) -> bytes:
        """Of the JSON without the signature, which is written in one way only."""
        return keccak256(_DOMAIN + replace(self, signature="").encode())
