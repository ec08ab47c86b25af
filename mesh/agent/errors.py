"""Errors of trading and of an agent's services. `JobFailed`, which handlers raise, is in `mesh.work.job`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.errors import AiraError

if TYPE_CHECKING:
    from schemas.signing import Rejection


class OrderRejected(AiraError, code="order-rejected"):
    """A provider can't use the order. `rejection` has the reason, a word for programs, and the detail."""

    def __init__(self, rejection: Rejection) -> None:
        super().__init__(
            f"provider {rejection.provider} rejects the order ({rejection.reason}): {rejection.detail}",
            hint="fix the reported problem and post a new order",
        )
        self.rejection = rejection


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


class ServiceClosed(AiraError, code="service-closed"):
    """A service that the agent's settings don't open to others: it signs, spends or drives jobs."""

    def __init__(self, service: str) -> None:
        super().__init__(
            f"this agent does not offer {service} to others",
            hint="set open_services = true on the agent, if only those who may use its account reach its router",
        )
        self.service = service


__all__ = ["LiabilityReverted", "OrderExpired", "OrderRejected", "ServiceClosed"]
