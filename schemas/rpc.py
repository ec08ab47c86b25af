"""The services of an agent, queryables under `aira/agent/{address}/rpc/`: what is asked and what is answered.

The fields bear the names they had in the legacy stack's ROS services. Amounts are in wei (`eth_balance`) or wn (XRT).
`SERVICES` says which request and reply belong to a service; an error is Zenoh's error reply with one line of text.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Final, NamedTuple

from schemas.liability import Liability  # msgspec reads the annotations
from schemas.records import Record, UInt256

if TYPE_CHECKING:
    from collections.abc import Mapping


class StartLiability(Record, frozen=True):
    """Begin to play the objective of the liability at `address`."""

    address: str


class FinishLiability(Record, frozen=True):
    """End the liability at `address`: close the recording, sign the Result and send it."""

    address: str
    success: bool


class RestartLiability(Record, frozen=True):
    """Play the objective of the liability at `address` again from its beginning."""

    address: str


class ResumeLiability(Record, frozen=True):
    """Play on the objective of the liability at `address` from where it stopped."""

    address: str


class ReadLiability(Record, frozen=True):
    """Ask for the record of the liability at `address`."""

    address: str


class Done(Record, frozen=True):
    """Whether it was done, and if not, why."""

    success: bool
    msg: str = ""


class Nothing(Record, frozen=True):
    """A request without arguments, or a reply without results."""


class LiabilityRead(Record, frozen=True):
    """The record, if there is such a liability (`read`)."""

    read: bool
    liability: Liability | None = None


class SignDemand(Record, frozen=True, kw_only=True, rename="camel"):
    """Sign and publish a Demand; the agent adds nonce, sender (generation 5) and signature."""

    model: str
    objective: str
    token: str
    cost: UInt256
    lighthouse: str
    validator: str
    validator_fee: UInt256
    deadline: UInt256


class SignOffer(Record, frozen=True, kw_only=True, rename="camel"):
    """Sign and publish an Offer; the agent adds nonce, sender (generation 5) and signature."""

    model: str
    objective: str
    token: str
    cost: UInt256
    lighthouse: str
    validator: str
    lighthouse_fee: UInt256
    deadline: UInt256


class SignResult(Record, frozen=True, kw_only=True):
    """Sign and publish a Result."""

    liability: str
    result: str
    success: bool


class Published(Record, frozen=True):
    """The message went out; `hash` is its hash, 64 hexadecimal digits."""

    hash: str


class AccountBalance(Record, frozen=True):
    """Ask for the balance of an account."""

    account: str


class AccountToAddressAllowance(Record, frozen=True):
    """Ask how much `to` may spend of what `account` has."""

    account: str
    to: str


class Transfer(Record, frozen=True):
    """Send `value` wn to `to`."""

    to: str
    value: UInt256


class TransferFrom(Record, frozen=True):
    """Send `value` wn of `owner`, who has approved it, to `to`."""

    owner: str
    to: str
    value: UInt256


class Approve(Record, frozen=True):
    """Let `spender` spend `value` wn."""

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
    """A transfer of XRT from or to the agent's account."""

    args_from: str
    args_to: str
    args_value: UInt256


class ApprovalEvent(Record, frozen=True):
    """An approval of XRT by or for the agent's account."""

    args_owner: str
    args_spender: str
    args_value: UInt256


class Service(NamedTuple):
    """What a service is asked, and what it answers."""

    request: type[Record]
    reply: type[Record]


SERVICES: Final[Mapping[str, Service]] = MappingProxyType(
    {
        "start": Service(StartLiability, Done),
        "finish": Service(FinishLiability, Nothing),
        "restart": Service(RestartLiability, Done),
        "resume": Service(ResumeLiability, Done),
        "read": Service(ReadLiability, LiabilityRead),
        "sign/demand": Service(SignDemand, Published),
        "sign/offer": Service(SignOffer, Published),
        "sign/result": Service(SignResult, Published),
        "eth/accounts": Service(Nothing, Accounts),
        "eth/account_eth_balance": Service(AccountBalance, Balance),
        "eth/eth_balance": Service(Nothing, Balance),
        "eth/current_block": Service(Nothing, BlockNumber),
        "eth/transfer": Service(Transfer, Transaction),
        "eth/transfer_from": Service(TransferFrom, Transaction),
        "eth/approve": Service(Approve, Transaction),
        "eth/account_xrt_balance": Service(AccountBalance, Balance),
        "eth/xrt_balance": Service(Nothing, Balance),
        "eth/account_xrt_allowance": Service(AccountToAddressAllowance, Allowance),
        "eth/xrt_allowance": Service(Nothing, Allowance),
    }
)
"""Every service by the part of its key after `rpc/`."""
