"""The services of an agent, queryables under `aira/agent/{address}/rpc/`: their requests and replies.

The fields have the names they had in the legacy stack's ROS services. Amounts are in wei (`eth_balance`) or in the
smallest unit of the agent's token, which is XRT (wn) unless its settings name another. Those of market messages have
the names that messages have on the wire: the agent that is asked signs and publishes one, or publishes one already
signed; addresses may be ENS names, and a model may be given by its name.

`SERVICES` maps a service to its request and reply; an error is Zenoh's error reply with one line of text.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Final, NamedTuple, Self

import msgspec

from schemas.address import keccak256
from schemas.errors import InvalidMessage, InvalidRecord
from schemas.messages import Demand, Offer, Permit, Result, equal_terms
from schemas.records import (
    MAX_UINT256,
    ControlRobot,
    DeviceStop,
    Liability,  # msgspec reads the annotations
    Record,
    RobotControl,
    UInt256,
    check_addresses,
)
from schemas.signing import Decline, SignedRecord, StopRequest  # msgspec reads the annotations
from schemas.status import LogsRead, ReadLogs, Status

if TYPE_CHECKING:
    from collections.abc import Mapping

    from schemas.messages import SignedMessage
    from schemas.signing import Verified


_MAX_DIGITS: Final = len(str(MAX_UINT256))


class _MessageRequest(Record, frozen=True, kw_only=True):
    """A request about a message of the market, whose fields it has."""

    kind: ClassVar[type[Any]]
    """The message's class."""

    @classmethod
    def of(cls, message: SignedMessage) -> Self:
        """The request to publish a signed message."""
        fields = msgspec.structs.asdict(message)
        return cls(**fields | ({"nonce": str(fields["nonce"])} if "nonce" in fields else {}))

    def message(self) -> Any:
        """The signed message to be published. Raises `InvalidMessage`."""
        nonce = getattr(self, "nonce", "")
        return self.unsigned(**({"nonce": _count(nonce)} if getattr(self, "sender", None) is not None else {}))

    def unsigned(self, **added: Any) -> Any:
        """The message with these further fields, to be signed. Raises `InvalidMessage`."""
        fields = msgspec.structs.asdict(self)
        plain = {name: int(value) if isinstance(value, UInt256) else value for name, value in fields.items()}
        return self.kind(**plain | added)


class _OrderRequest(_MessageRequest, frozen=True, kw_only=True, rename="camel"):
    """The fields that requests for a Demand and for an Offer share."""

    model: str
    objective: str
    token: str
    cost: UInt256
    lighthouse: str
    validator: str
    deadline: UInt256


class SignDemand(_OrderRequest, frozen=True, kw_only=True, rename="camel"):
    """Sign and publish a Demand; the agent adds nonce, sender (generation 5) and signature."""

    kind: ClassVar = Demand
    validator_fee: UInt256


class SignOffer(_OrderRequest, frozen=True, kw_only=True, rename="camel"):
    """Sign and publish an Offer; the agent adds nonce, sender (generation 5) and signature."""

    kind: ClassVar = Offer
    lighthouse_fee: UInt256


class SignResult(_MessageRequest, frozen=True, kw_only=True):
    """Sign and publish a Result."""

    kind: ClassVar = Result
    liability: str
    result: str
    success: bool


class SendDemand(SignDemand, frozen=True, kw_only=True, rename="camel", omit_defaults=True):
    """Publish a signed Demand. `nonce` is 64 hexadecimal digits, or decimal digits if there is a `sender`."""

    nonce: str
    sender: str | None = None
    signature: str


class SendOffer(SignOffer, frozen=True, kw_only=True, rename="camel", omit_defaults=True):
    """Publish a signed Offer. `nonce` is 64 hexadecimal digits, or decimal digits if there is a `sender`."""

    nonce: str
    sender: str | None = None
    signature: str


class SendResult(SignResult, frozen=True, kw_only=True):
    """Publish a signed Result."""

    signature: str


class SendPermit(_MessageRequest, frozen=True, kw_only=True):
    """A signed Permit beside a demand."""

    kind: ClassVar[type[Any]] = Permit
    owner: str
    spender: str
    token: str
    value: UInt256
    nonce: UInt256
    deadline: UInt256
    domain: str
    signature: str

    @classmethod
    def of(cls, message: SignedMessage) -> Self:
        return cls(**msgspec.structs.asdict(message))

    def message(self) -> Any:
        return self.unsigned()


class AcceptDemand(SignedRecord, frozen=True, kw_only=True):
    """Ask a robot for its offer for a demand that is for it alone; nothing of it is published.

    The demand's signature is empty: the robot gets nothing that another could use. `maker` (EIP-55) signs the request,
    and the demand later.
    """

    domain: ClassVar = b"aira accept\0"
    author: ClassVar = "maker"

    demand: SendDemand
    robot: str
    maker: str


class Accepted(Record, frozen=True, kw_only=True, omit_defaults=True):
    """The robot's signed offer for the demand, or why it makes none; one of the two."""

    offer: SendOffer | None = None
    decline: Decline | None = None


class OrderPair(SignedRecord, frozen=True, kw_only=True, omit_defaults=True):
    """Ask a provider to create the contract of a demand and an offer, and to match neither with anything else.

    The demand's `maker` (EIP-55) signs this, too: so nobody else can bind a demand to an offer.
    """

    domain: ClassVar = b"aira pair\0"
    author: ClassVar = "maker"

    demand: SendDemand
    offer: SendOffer
    maker: str
    permit: SendPermit | None = None
    """The maker's, by which it pays what the demand costs."""

    def check(self, demand: Verified[Demand], offer: Verified[Offer]) -> None:
        """Raise `InvalidMessage` unless its maker has signed its demand, and that agrees with its offer.

        `demand` and `offer` are its messages, verified. Whether the pair `is_signed` is checked before.
        """
        if demand.signer != self.maker:
            raise InvalidMessage("maker", "only the demand's maker can bind it to an offer")
        if equal_terms(demand.message) != equal_terms(offer.message):
            raise InvalidMessage("terms", "the demand and the offer don't agree")


class PairTaken(Record, frozen=True, omit_defaults=True):
    """The provider creates the contract when its turn comes; or, with a `code` and a `detail`, why it does not."""

    code: str = ""
    detail: str = ""


class PermitFeeRequest(Record, frozen=True, kw_only=True):
    """Ask a provider what it wants for a contract that it creates with a permit of `maker` (EIP-55).

    The demand costs `cost`, in the smallest unit of `token` (EIP-55), and has orders of this `generation`.
    """

    maker: str
    generation: int
    token: str
    cost: UInt256

    def __post_init__(self) -> None:
        Record.__post_init__(self)
        check_addresses(self, "maker", "token")
        if self.generation not in (3, 5):
            raise InvalidRecord("PermitFeeRequest", "generation: expected 3 or 5")


class PermitFee(Record, frozen=True):
    """The least `permit_fee` for which the provider creates the contract now, in the smallest unit of the token.

    0 if it wants none: it creates the contract without, or no fee in this token would make it do so.
    """

    fee: UInt256


class QuoteRequest(SignedRecord, frozen=True, kw_only=True):
    """Ask a robot what it wants for an objective (CID) by a model (CID), signed by the `asker` (EIP-55)."""

    domain: ClassVar = b"aira quote request\0"
    author: ClassVar = "asker"

    model: str
    objective: str
    lighthouse: str
    asker: str
    nonce: str
    time: int
    """Unix seconds, by the asker's clock."""

    @property
    def identity(self) -> str:
        """Its hash, which a quote names: 64 hexadecimal digits."""
        return keccak256(self.encode()).hex()


class Quote(SignedRecord, frozen=True, kw_only=True, omit_defaults=True):
    """What a robot wants for a job, or, with a `code` and a `detail`, why it does not want it. It binds nobody.

    `cost` is in the smallest unit of `token`. `start` is in how many seconds it would begin, `seconds` how long it
    takes (0: not known), both estimated; `until` the block until which it means this.
    """

    domain: ClassVar = b"aira quote\0"
    author: ClassVar = "agent"

    agent: str
    request: str
    cost: UInt256 = 0
    token: str = ""
    validator: str = ""
    """The validator that it insists on; empty for any or none."""
    start: float = 0.0
    seconds: float = 0.0
    until: int = 0
    code: str = ""
    detail: str = ""

    def __post_init__(self) -> None:
        Record.__post_init__(self)
        if not self.code:
            check_addresses(self, "token")


class Published(Record, frozen=True):
    """The message was published; `hash` is its hash, 64 hexadecimal digits."""

    hash: str


def _count(nonce: str) -> int:
    if not (nonce.isascii() and nonce.isdigit() and len(nonce) <= _MAX_DIGITS):
        raise InvalidMessage("nonce", "the nonce of a generation-5 order is a number in decimal digits")
    return int(nonce)


class LiabilityRequest(Record, frozen=True):
    """Read the record of the liability at `address`; or play its objective: from the start, from the start again, or on
    from where it stopped."""

    address: str


class FinishLiability(Record, frozen=True):
    """Finish the job of the liability at `address`: close the recording, sign the Result and send it."""

    address: str
    success: bool


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


class Stopped(Record, frozen=True):
    """The job is stopped for good; `devices` are those that were present. None are told of a job that had not begun."""

    devices: tuple[DeviceStop, ...] = ()


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
        "start": Service(LiabilityRequest, Done),
        "finish": Service(FinishLiability, Nothing),
        "restart": Service(LiabilityRequest, Done),
        "resume": Service(LiabilityRequest, Done),
        "read": Service(LiabilityRequest, LiabilityRead),
        "stop": Service(StopRequest, Stopped),
        "control": Service(ControlRobot, RobotControl),
        "status": Service(Nothing, Status),
        "logs": Service(ReadLogs, LogsRead),
        "accept": Service(AcceptDemand, Accepted),
        "pair": Service(OrderPair, PairTaken),
        "permit-fee": Service(PermitFeeRequest, PermitFee),
        "quote": Service(QuoteRequest, Quote),
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
    "control",
    "sign/demand",
    "sign/offer",
    "sign/result",
    "send/demand",
    "send/offer",
    "send/result",
}
"""The services of the agent's owner: they sign, spend or publish in its name, or control it. Offered only if its
settings allow it."""
