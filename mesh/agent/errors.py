"""Errors of trading and of an agent's services. `JobFailed`, which handlers raise, is in `mesh.agent.handlers`."""

from __future__ import annotations

from mesh.errors import AiraError, InputError
from schemas.signing import LONGEST_DETAIL, is_word


class OrderClosed(AiraError, code="order-closed"):
    """The order is not open any more: `state` is `withdrawn`, or `matched`, with the contract's address `liability`."""

    def __init__(self, order: str, state: str, *, liability: str = "") -> None:
        became = f"became the contract {liability}" if liability else f"was {state}"
        super().__init__(
            f"the order {order[:16]}… {became}",
            hint="" if liability else "it may still become a contract until its deadline; see `aira order list`",
        )
        self.order = order
        self.state = state
        self.liability = liability


class Declined(AiraError, code="declined"):
    """Raise it in a demand's handler: the agent does not work for this demand, and its maker gets a `Decline`.

    `reason` is a word for programs (`too-cheap`: lower-case letters, digits, hyphens), `detail` a line for people, cut
    after `LONGEST_DETAIL` characters. Raises `InputError` for another word.
    """

    def __init__(self, reason: str, detail: str = "") -> None:
        if not is_word(reason):
            raise InputError(f"{reason!r} is not a valid code", hint="use lower-case letters, digits and hyphens")
        super().__init__(f"declined ({reason}): {detail}" if detail else f"declined ({reason})")
        self.reason = reason
        self.detail = detail[:LONGEST_DETAIL]


class OrderExpired(AiraError, code="order-expired"):
    """No offer matched the order before its deadline, the block `deadline`. `order` is its hash."""

    def __init__(self, order: str, deadline: int) -> None:
        super().__init__(
            f"no counterpart matched the order {order[:16]}… before block {deadline}",
            hint="offer more, or give the order a longer lifetime",
        )
        self.order = order
        self.deadline = deadline


class LiabilityReverted(AiraError, code="liability-reverted"):
    """A reorganisation reverted the contract `liability`, and it was not created again by its orders' deadline."""

    def __init__(self, liability: str, deadline: int) -> None:
        super().__init__(
            f"a reorganisation reverted the contract {liability}, and it was not created again by block {deadline}",
            hint="it pays nobody; post a new order, unless another contract was created from its orders",
        )
        self.liability = liability
        self.deadline = deadline
