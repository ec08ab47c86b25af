"""Errors of trading and of an agent's services. `JobFailed`, which handlers raise, is in `mesh.agent.handlers`."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

from mesh.errors import AiraError, ClosedError, InputError, RemoteError, public_text
from schemas.signing import LONGEST_DETAIL, is_word

if TYPE_CHECKING:
    from collections.abc import Sequence

    from schemas.signing import Decline


ENDED: Final = partial(ClosedError, "the agent has ended", hint="run it again: demands stay open until their deadline")
"""The error of those who wait for something when the agent ends."""


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


class DemandDeclined(RemoteError, code="demand-declined"):
    """The robot that a demand is for, or all that are present, do not work for it: `declines` has the word of each.

    `order` is the demand's hash.
    """

    def __init__(self, order: str, declines: Sequence[Decline]) -> None:
        said = "; ".join(f"{one.agent}: {public_text(one.detail) or one.code} ({one.code})" for one in declines[:3])
        more = f"; and {len(declines) - 3} more" if len(declines) > 3 else ""
        super().__init__(
            f"declined by {said}{more}",
            hint="offer other terms, or ask another robot; `aira robots` shows who is present",
        )
        self.order = order
        self.declines = tuple(declines)


class OtherRobot(AiraError, code="other-robot"):
    """A demand for `robot` (address) alone became the contract `liability` with another one, `promisor`.

    A provider has broken its word, or somebody read the pair on its way to it.
    """

    def __init__(self, order: str, *, robot: str, promisor: str, liability: str) -> None:
        super().__init__(
            f"the order {order[:16]}… for {robot} became the contract {liability} with {promisor}",
            hint="who sent its transaction is the provider that broke its word; `aira liability show` has more",
        )
        self.order = order
        self.robot = robot
        self.promisor = promisor
        self.liability = liability


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
