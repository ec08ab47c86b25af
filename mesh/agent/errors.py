"""What can go wrong in trading and in doing a job, beyond what the parts raise."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.errors import AiraError

if TYPE_CHECKING:
    from schemas.signing import Rejection


class JobFailed(AiraError):
    """Raised by a handler to end its job without success, which refunds the promisee; the text says why."""

    code = "job-failed"


class OrderRejected(AiraError):
    """A provider says that an order can't be used; `rejection` holds its machine-readable reason."""

    code = "order-rejected"

    def __init__(self, rejection: Rejection) -> None:
        super().__init__(
            f"provider {rejection.provider} rejects the order ({rejection.reason}): {rejection.detail}",
            hint="mend what the reason names and post a new order",
        )
        self.rejection = rejection


class ServiceClosed(AiraError):
    """A service that others may not use: it signs, spends or drives jobs, and the settings don't open it."""

    code = "service-closed"

    def __init__(self, service: str) -> None:
        super().__init__(
            f"this agent does not offer {service} to others",
            hint="on the agent: open_services = true, behind a router that only those reach who may use its account",
        )
        self.service = service


class OrderExpired(AiraError):
    """An order's deadline has passed and nobody took it."""

    code = "order-expired"

    def __init__(self, order: str, deadline: int) -> None:
        super().__init__(
            f"nobody took the order {order[:16]}… until block {deadline}",
            hint="offer more, or give it a longer lifetime",
        )
        self.order = order
        self.deadline = deadline


class ContractTakenBack(AiraError):
    """The chain was reorganised, and a contract of before was not made again until its orders' deadline."""

    code = "contract-taken-back"

    def __init__(self, liability: str, deadline: int) -> None:
        super().__init__(
            f"the chain took the contract {liability} back, and it was not made again until block {deadline}",
            hint="it pays nobody; post a new order, unless another contract was made of its orders",
        )
        self.liability = liability
        self.deadline = deadline


class ShortOfFunds(AiraError):
    """The account can't pay what it wants to promise: units of the token that it has, and that it needs."""

    code = "short-of-funds"

    def __init__(self, account: str, token: str, *, balance: int, needed: int) -> None:
        super().__init__(
            f"account {account} has {balance} of token {token}, and {needed} are needed",
            hint="send it the missing tokens, or lower the cost",
        )
        self.balance = balance
        self.needed = needed


__all__ = ["ContractTakenBack", "JobFailed", "OrderExpired", "OrderRejected", "ServiceClosed", "ShortOfFunds"]
