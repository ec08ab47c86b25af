"""What those see who wait for a job: offers and declines, the contract, the playback, the result, the payment."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, TypeAlias

import msgspec

Kind: TypeAlias = Literal["offer", "declined", "rejected", "contract", "ready", "playing", "result", "paid", "refunded"]


class Progress(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Something that happened to an order or its contract; `kind` says what:

    - `offer`: `agent` offers this work; with the code `other-terms` for other terms, which `detail` names.
    - `declined`: `agent` does not work for the demand; `code` and `detail` say why.
    - `rejected`: the provider `agent` can't use the order now; `code` and `detail` say why.
    - `contract`: the order became the contract `detail` (address) with `agent`.
    - `ready`: `agent` has checked the objective.
    - `playing`: `agent` has played `position` of `total` messages.
    - `result`: `agent` has signed the result `detail` (CID); its code is `failed` if the job was not done.
    - `paid`, `refunded`: the contract has ended; `refunded` has the code and the detail of the failure.

    What an agent says of its job before the end is its own word, and may be lost on the way.
    """

    kind: Kind
    agent: str = ""
    """Whose word it is: an address (EIP-55)."""
    code: str = ""
    """A word for programs."""
    detail: str = ""
    """For people; it may come from a stranger."""
    position: int = 0
    total: int = 0


OnProgress: TypeAlias = Callable[[Progress], object]
