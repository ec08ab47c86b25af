"""A provider's word that an order or a Result can't be used, and why; put on `aira/{lighthouse}/reject/…`."""

from __future__ import annotations

from schemas.records import Record


class Rejection(Record, frozen=True, kw_only=True):
    """Why a provider will not use a message.

    `order` is the message's hash (64 hexadecimal digits), `reason` a machine-readable word (a refusal of the order
    book, or the name of the contracts' error), `detail` is for people, `provider` the EIP-55 address of who says so.
    It is unsigned: a hint, not a proof.
    """

    order: str
    reason: str
    detail: str
    provider: str
