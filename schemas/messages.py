"""The messages of a market: Demand, Offer, Withdrawal and Result, and the feedback of generation 5.

Every message object is well-formed: the constructors check each field, bring it to its canonical form (addresses in
EIP-55, ENS names and hexadecimal digits in lower case and without `0x`) and raise `InvalidMessage` for what is wrong.
They don't verify the signature; `schemas.signing` does. A message is hashed with addresses only: collect its ENS names
with `names_in`, look them up on a chain, and replace them with `resolve_names`.

To add a kind of message: its class here, in `MESSAGE_TYPES`; what its hash covers in `schemas.wire`; its key in
`schemas.keys`; its selector in `schemas.selectors`; who may publish it in `mesh.identity.roster`.

Amounts are integers of at most 256 bits: `cost` in the token's smallest unit, fees in wn (10^-9 XRT), `deadline` is a
block number (the order is valid while `block.number < deadline`). Source: the wire format of the legacy network.
"""

from __future__ import annotations

from functools import lru_cache
from sys import intern
from typing import TYPE_CHECKING, ClassVar, Final, Literal, NoReturn, TypeAlias, TypeVar, final

from msgspec import Struct
from msgspec.structs import force_setattr, replace

from schemas.address import parse_address, parse_address_or_name
from schemas.cid import parse_cid
from schemas.errors import InvalidAddress, InvalidCid, InvalidMessage
from schemas.keys import MarketKind  # msgspec reads the annotations
from schemas.message_fields import (
    are_canonical,
    are_uint256,
    check_uint256,
    hex_digits,
    set_address,
    set_hash,
    set_signature,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

_CACHED: Final = 8192
_NO_NAMES: Final[frozenset[str]] = frozenset()


@lru_cache(maxsize=_CACHED)
def _market_fields(model: str, token: str, lighthouse: str, validator: str) -> tuple[str, str, str, str]:
    """The canonical texts of what most orders of a market have in common: checked once, and in memory once."""
    parse_cid(model)
    token, lighthouse, validator = (parse_address_or_name(text) for text in (token, lighthouse, validator))
    if validator == lighthouse:
        # With the two exchanged, an offer is a demand with the same signature: see mesh/chain/validators.py.
        raise InvalidMessage("validator", "the lighthouse can't be the validator")
    return intern(model), token, lighthouse, validator


class _Message(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True, gc=False):
    """The base of all messages: an unknown field is an error, and a field that is not set is not written."""

    kind: ClassVar[MarketKind]
    """The name of the kind, as keys and metrics have it."""
    mark: ClassVar[str]
    """The field on the wire by which a reader recognizes the kind."""
    address_fields: ClassVar[tuple[str, ...]] = ()
    """The fields that hold an address or an ENS name."""

    @property
    def key_model(self) -> str:
        """The model that its key names; empty for all but orders."""
        return ""


class _Order(_Message, frozen=True, kw_only=True, rename="camel"):
    """The fields that a Demand and an Offer have in common."""

    address_fields: ClassVar[tuple[str, ...]] = ("token", "lighthouse", "validator", "sender")

    model: str
    objective: str
    token: str
    cost: int
    lighthouse: str
    validator: str
    deadline: int
    nonce: str | int
    sender: str | None = None
    signature: str = ""

    @property
    def key_model(self) -> str:
        """The model's CID."""
        return self.model

    @property
    def generation(self) -> Literal[3, 5]:
        """The generation of the message format: 5 if the order has a sender, else 3."""
        return 3 if self.sender is None else 5

    def _check(self, fee_field: str, fee: int) -> None:
        """Check all fields, and bring them to their canonical form."""
        try:
            model, token, lighthouse, validator = _market_fields(
                self.model, self.token, self.lighthouse, self.validator
            )
            parse_cid(self.objective)
            if self.sender is not None:
                set_address(self, "sender", self.sender)
        except (InvalidCid, InvalidAddress) as error:
            _raise_invalid(self, error)
        force_setattr(self, "model", model)
        force_setattr(self, "token", token)
        force_setattr(self, "lighthouse", lighthouse)
        force_setattr(self, "validator", validator)
        if not are_uint256(self.cost, self.deadline, fee):
            for field, value in (("cost", self.cost), ("deadline", self.deadline), (fee_field, fee)):
                check_uint256(field, value)
        nonce, signature = self.nonce, self.signature
        is_long = self.sender is None and len(signature) == 130
        if is_long and isinstance(nonce, str) and len(nonce) == 64 and are_canonical(nonce, signature):
            return
        self._set_nonce()
        set_signature(self, signature)

    def _set_nonce(self) -> None:
        nonce = self.nonce
        if self.sender is not None:
            if type(nonce) is not int:
                raise InvalidMessage("nonce", "the nonce of a generation-5 order is an integer")
            check_uint256("nonce", nonce)
            return
        digits = hex_digits(nonce, 32) if type(nonce) is str else None
        if digits is None:
            raise InvalidMessage("nonce", "the nonce of a generation-3 order is 64 hexadecimal digits")
        if digits != nonce:
            force_setattr(self, "nonce", digits)


@final
class Demand(_Order, frozen=True, kw_only=True):
    """A promisee's order: it pays `cost` of `token` for doing `objective` by `model` before `deadline`.

    `nonce` is 64 hexadecimal digits in generation 3 and the factory's `nonceOf(sender)` in generation 5; only
    generation 5 has a `sender`. `validator` is the zero address if there is none; `validator_fee` is in wn.
    """

    kind: ClassVar[MarketKind] = "demand"
    mark: ClassVar[str] = "validatorFee"

    validator_fee: int

    def __post_init__(self) -> None:
        self._check("validatorFee", self.validator_fee)


@final
class Offer(_Order, frozen=True, kw_only=True):
    """A promisor's order: it does `objective` by `model` for `cost` of `token`.

    It pays `lighthouse_fee` wn to the provider; `nonce` and `sender` are as in a `Demand`.
    """

    kind: ClassVar[MarketKind] = "offer"
    mark: ClassVar[str] = "lighthouseFee"

    lighthouse_fee: int

    def __post_init__(self) -> None:
        self._check("lighthouseFee", self.lighthouse_fee)


@final
class Withdrawal(_Message, frozen=True, kw_only=True, rename={"order": "withdraws"}):
    """A maker's statement that its order must not become a contract any more.

    `order` is the order's hash (64 hexadecimal digits); `lighthouse` and `deadline` are those of the order. It concerns
    only an order that its own signer has signed: other accounts can sign equal terms. Keep it until `deadline`: the
    order may still be sent, or sent again, by others. On the wire `order` is called `withdraws`.
    """

    kind: ClassVar[MarketKind] = "withdrawal"
    mark: ClassVar[str] = "withdraws"
    address_fields: ClassVar[tuple[str, ...]] = ("lighthouse",)

    order: str
    lighthouse: str
    deadline: int
    signature: str = ""

    def __post_init__(self) -> None:
        set_hash(self, "order", self.order)
        try:
            set_address(self, "lighthouse", self.lighthouse)
        except InvalidAddress as error:
            _raise_invalid(self, error)
        check_uint256("deadline", self.deadline)
        set_signature(self, self.signature)


@final
class Result(_Message, frozen=True, kw_only=True):
    """A promisor's report: `result` is the CID of the recording, `success` whether the job was done.

    `liability` is the contract's address or, in answer to a Demand of cost 0 without a contract, the address of the
    promisee.
    """

    kind: ClassVar[MarketKind] = "result"
    mark: ClassVar[str] = "liability"
    address_fields: ClassVar[tuple[str, ...]] = ("liability",)

    liability: str
    result: str
    success: bool
    signature: str = ""

    def __post_init__(self) -> None:
        try:
            set_address(self, "liability", self.liability)
            parse_cid(self.result)
        except (InvalidCid, InvalidAddress) as error:
            _raise_invalid(self, error)
        if type(self.success) is not bool:
            raise InvalidMessage("field", "success: expected a boolean")
        set_signature(self, self.signature)


class OrderFeedback(_Message, frozen=True, kw_only=True):
    """A generation-5 provider's feedback on an order: `order` is the order's hash, 64 hexadecimal digits.

    What its signature covers is not documented, so it can't be verified.
    """

    kind: ClassVar[MarketKind] = "feedback"
    mark: ClassVar[str] = "accepted"

    order: str
    accepted: int
    signature: str

    def __post_init__(self) -> None:
        set_hash(self, "order", self.order)
        check_uint256("accepted", self.accepted)
        set_signature(self, self.signature)


class TransactionFeedback(_Message, frozen=True, kw_only=True):
    """A generation-5 provider's notice of a transaction it has sent: `tx` is its hash, 64 hexadecimal digits."""

    kind: ClassVar[MarketKind] = "pending"
    mark: ClassVar[str] = "tx"

    tx: str

    def __post_init__(self) -> None:
        set_hash(self, "tx", self.tx)


Order: TypeAlias = Demand | Offer
SignedMessage: TypeAlias = Demand | Offer | Withdrawal | Result
Message: TypeAlias = SignedMessage | OrderFeedback | TransactionFeedback

MESSAGE_TYPES: Final[tuple[type[Message], ...]] = (
    Demand,
    Offer,
    OrderFeedback,
    TransactionFeedback,
    Result,
    Withdrawal,
)
"""Every kind of message, in the order in which a reader looks for their marks: the first that is present decides."""


_AnyMessage = TypeVar("_AnyMessage", bound=Message)


def names_in(message: Message) -> frozenset[str]:
    """The ENS names in the address fields of a message, in lower case."""
    # Every ENS name has a dot, and no address has one. Every message passes here, so no generator is created.
    names = _NO_NAMES
    for field in message.address_fields:
        text = getattr(message, field)
        if text is not None and "." in text:
            names |= {text}
    return names


def resolve_names(message: _AnyMessage, addresses: Mapping[str, str]) -> _AnyMessage:
    """The message with every ENS name replaced by its address; `addresses` maps lower-case names to addresses.

    Raises `InvalidMessage` (`unresolved-name`) if a name is missing, `InvalidAddress` if it maps to no address.
    """
    names = names_in(message)
    if not names:
        return message
    if missing := names - addresses.keys():
        raise InvalidMessage("unresolved-name", f"no address is known for {', '.join(sorted(missing))}")
    texts = {field: getattr(message, field) for field in message.__struct_fields__}
    return replace(message, **{field: parse_address(addresses[text]) for field, text in texts.items() if text in names})


def _raise_invalid(message: Struct, error: InvalidCid | InvalidAddress) -> NoReturn:
    field = next(name for name in message.__struct_fields__ if getattr(message, name) == error.text)
    reason = "cid" if isinstance(error, InvalidCid) else "address"
    raise InvalidMessage(reason, f"{field}: {error}") from error
