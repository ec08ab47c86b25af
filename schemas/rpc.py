"""The services of an agent, queryables under `aira/agent/{address}/rpc/`: their requests and replies.

The fields have the names they had in the legacy stack's ROS services. Amounts are in wei (`eth_balance`) or in the
smallest unit of the agent's token, which is XRT (wn) unless its settings name another.
`SERVICES` maps a service to its request and reply; an error is Zenoh's error reply with one line of text.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Final, NamedTuple

from schemas.logs import LogsRead, ReadLogs
from schemas.message_requests import Published, SendDemand, SendOffer, SendResult, SignDemand, SignOffer, SignResult
from schemas.records import Liability, Record, UInt256  # msgspec reads the annotations
from schemas.status import Status

if TYPE_CHECKING:
    from collections.abc import Mapping


class StartLiability(Record, frozen=True):
    """Start to play the objective of the liability at `address`."""

    address: str


class FinishLiability(Record, frozen=True):
    """Finish the job of the liability at `address`: close the recording, sign the Result and send it."""

    address: str
    success: bool


class RestartLiability(Record, frozen=True):
    """Play the objective of the liability at `address` again from the start."""

    address: str


class ResumeLiability(Record, frozen=True):
    """Continue to play the objective of the liability at `address` where it stopped."""

    address: str


class ReadLiability(Record, frozen=True):
    """Request the record of the liability at `address`."""

    address: str


class Done(Record, frozen=True):
    """Whether it was done, and why not."""

    success: bool
    msg: str = ""


class Nothing(Record, frozen=True):
    """A request without arguments, or a reply without results."""


class LiabilityRead(Record, frozen=True):
    """The record; `read` says whether the liability exists."""

    read: bool
    liability: Liability | None = None


class AccountBalance(Record, frozen=True):
    """Request the balance of an account."""

    account: str


class AccountToAddressAllowance(Record, frozen=True):
    """Request the allowance of `to` on the tokens of `account`."""

    account: str
    to: str


class TransferRequest(Record, frozen=True):
    """Send `value` wn to `to`."""

    to: str
    value: UInt256


class TransferFromRequest(Record, frozen=True):
    """Send `value` wn of `owner` to `to`, by an allowance of `owner`."""

    owner: str
    to: str
    value: UInt256


class Approve(Record, frozen=True):
    """Allow `spender` to spend `value` wn."""

    spender: str
    value: UInt256


class Accounts(Record, frozen=True):
    """The agent's accounts."""

    accounts: tuple[str, ...]


class Balance(Record, frozen=True):
    """A balance, in wei or wn."""

    balance: UInt256


class Allowance(Record, frozen=True):
    """An allowance, in wn."""

    amount: UInt256


class BlockNumber(Record, frozen=True):
    """The number of the newest block."""

    number: int


class Transaction(Record, frozen=True):
    """The hash of the transaction that was sent, 64 hexadecimal digits after `0x`."""

    txhash: str


class TransferEvent(Record, frozen=True):
    """A transfer of the token from or to the agent's account."""

    args_from: str
    args_to: str
    args_value: UInt256


class ApprovalEvent(Record, frozen=True):
    """An approval of the token by or for the agent's account."""

    args_owner: str
    args_spender: str
    args_value: UInt256


class Service(NamedTuple):
    """The request and the reply of a service."""

    request: type[Record]
    reply: type[Record]


SERVICES: Final[Mapping[str, Service]] = MappingProxyType(
    {
        "start": Service(StartLiability, Done),
        "finish": Service(FinishLiability, Nothing),
        "restart": Service(RestartLiability, Done),
        "resume": Service(ResumeLiability, Done),
        "read": Service(ReadLiability, LiabilityRead),
        "status": Service(Nothing, Status),
        "logs": Service(ReadLogs, LogsRead),
        "sign/demand": Service(SignDemand, Published),
        "sign/offer": Service(SignOffer, Published),
        "sign/result": Service(SignResult, Published),
        "send/demand": Service(SendDemand, Published),
        "send/offer": Service(SendOffer, Published),
        "send/result": Service(SendResult, Published),
        "eth/accounts": Service(Nothing, Accounts),
        "eth/account_eth_balance": Service(AccountBalance, Balance),
        "eth/eth_balance": Service(Nothing, Balance),
        "eth/current_block": Service(Nothing, BlockNumber),
        "eth/transfer": Service(TransferRequest, Transaction),
        "eth/transfer_from": Service(TransferFromRequest, Transaction),
        "eth/approve": Service(Approve, Transaction),
        "eth/account_xrt_balance": Service(AccountBalance, Balance),
        "eth/xrt_balance": Service(Nothing, Balance),
        "eth/account_xrt_allowance": Service(AccountToAddressAllowance, Allowance),
        "eth/xrt_allowance": Service(Nothing, Allowance),
    }
)
"""All services, by the part of their key after `rpc/`."""

SPENDING: Final = frozenset({"eth/transfer", "eth/transfer_from", "eth/approve"})
"""The services that send a transaction, and wait until it is mined."""

GUARDED: Final = SPENDING | {
    "sign/demand",
    "sign/offer",
    "sign/result",
    "send/demand",
    "send/offer",
    "send/result",
}
"""The services that sign, spend or publish in the agent's name: offered only if its settings allow it."""
