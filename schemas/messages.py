"""The messages of a market: Demand, Offer and Result, and the feedback of generation 5.

A message that exists is well-formed: the constructors check every field, bring it to its canonical form (addresses in
EIP-55, ENS names and hexadecimal digits in lower case and without `0x`) and raise `InvalidMessage` for what can't be.
What they can't know is whether the signature is right; `schemas.signing` says that.

Amounts are integers of at most 256 bits: `cost` in the token's smallest unit, fees in wn (10^-9 XRT), `deadline` is a
block number (the order is valid while `block.number < deadline`). Source: the wire format of the legacy network.
"""

from __future__ import annotations

from sys import intern
from typing import Final, Literal, NoReturn, TypeAlias

from msgspec import Struct
from msgspec.structs import force_setattr

from schemas.address import parse_address_or_name
from schemas.cid import parse_cid
from schemas.errors import InvalidAddress, InvalidCid, InvalidMessage

MAX_UINT256: Final = 2**256 - 1

SIGNATURE_SIZE: Final = 65


class _Message(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True, gc=False):
    """What all messages have in common: an unknown field is an error, and one that is not set is not written."""


class _Terms(_Message, frozen=True, kw_only=True, rename="camel"):
    """What a Demand and an Offer have in common."""

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
    def generation(self) -> Literal[3, 5]:
        """The generation of the network whose rules the order follows: 5 if it names its sender, else 3."""
        return 3 if self.sender is None else 5

    def __post_init__(self) -> None:
        try:
            parse_cid(self.model)
            force_setattr(self, "model", intern(self.model))
            parse_cid(self.objective)
            _settle_address(self, "token", self.token)
            _settle_address(self, "lighthouse", self.lighthouse)
            _settle_address(self, "validator", self.validator)
            if self.sender is not None:
                _settle_address(self, "sender", self.sender)
        except (InvalidCid, InvalidAddress) as error:
            _refuse(self, error)
        _check_uint256("cost", self.cost)
        _check_uint256("deadline", self.deadline)
        self._settle_nonce()
        _settle_signature(self, self.signature)

    def _settle_nonce(self) -> None:
        nonce = self.nonce
        if self.sender is not None:
            if type(nonce) is not int:
                raise InvalidMessage("nonce", "the nonce of a generation-5 order is an integer")
            _check_uint256("nonce", nonce)
        elif type(nonce) is not str:
            raise InvalidMessage("nonce", "the nonce of a generation-3 order is 64 hexadecimal digits")
        else:
            digits = _hex_digits(nonce, 32)
            if digits is None:
                raise InvalidMessage("nonce", "the nonce of a generation-3 order is 64 hexadecimal digits")
            if digits != nonce:
                force_setattr(self, "nonce", digits)


class Demand(_Terms, frozen=True, kw_only=True):
    """A promisee's order: who does `objective` by `model` until `deadline` gets `cost` of `token`.

    `nonce` is 64 hexadecimal digits in generation 3 and the factory's `nonceOf(sender)` in generation 5; `sender` is
    there in generation 5 only. `validator` is the zero address if there is none; `validator_fee` is in wn.
    """

    validator_fee: int

    def __post_init__(self) -> None:
        _Terms.__post_init__(self)
        _check_uint256("validatorFee", self.validator_fee)


class Offer(_Terms, frozen=True, kw_only=True):
    """A promisor's order: does `objective` by `model` for `cost` of `token`.

    It pays `lighthouse_fee` wn to the provider; `nonce` and `sender` are as in a `Demand`.
    """

    lighthouse_fee: int

    def __post_init__(self) -> None:
        _Terms.__post_init__(self)
        _check_uint256("lighthouseFee", self.lighthouse_fee)


class Result(_Message, frozen=True, kw_only=True):
    """A promisor's report: `result` is the CID of the recording, `success` whether the job was done.

    `liability` is the contract's address or, for an answer to a Demand that cost nothing and made no contract, the
    address of the one who asked.
    """

    liability: str
    result: str
    success: bool
    signature: str = ""

    def __post_init__(self) -> None:
        try:
            _settle_address(self, "liability", self.liability)
            parse_cid(self.result)
        except (InvalidCid, InvalidAddress) as error:
            _refuse(self, error)
        if type(self.success) is not bool:
            raise InvalidMessage("field", "success: expected a boolean")
        _settle_signature(self, self.signature)


class OrderFeedback(_Message, frozen=True, kw_only=True):
    """A generation-5 provider's word that it has taken an order: `order` is the order's hash, 64 hexadecimal digits.

    What its signature covers is not documented, so it can't be verified.
    """

    order: str
    accepted: int
    signature: str

    def __post_init__(self) -> None:
        _settle_hash(self, "order", self.order)
        _check_uint256("accepted", self.accepted)
        _settle_signature(self, self.signature)


class TransactionFeedback(_Message, frozen=True, kw_only=True):
    """A generation-5 provider's word that it has sent a transaction: `tx` is its hash, 64 hexadecimal digits."""

    tx: str

    def __post_init__(self) -> None:
        _settle_hash(self, "tx", self.tx)


Order: TypeAlias = Demand | Offer
SignedMessage: TypeAlias = Demand | Offer | Result
Message: TypeAlias = Demand | Offer | Result | OrderFeedback | TransactionFeedback


def _settle_address(message: Struct, field: str, text: str) -> None:
    # The cached text replaces its equal: the same few addresses stand in a million open orders, and in memory once.
    canonical = parse_address_or_name(text)
    if canonical is not text:
        force_setattr(message, field, canonical)


def _check_uint256(field: str, value: int) -> None:
    if type(value) is not int:
        raise InvalidMessage("field", f"{field}: expected an integer")
    if not 0 <= value <= MAX_UINT256:
        raise InvalidMessage("range", f"{field}: expected an integer from 0 to 2^256-1")


def _settle_signature(message: Struct, text: str) -> None:
    if not text:
        return
    digits = _hex_digits(text, SIGNATURE_SIZE)
    if digits is None:
        raise InvalidMessage("signature", "a signature is 130 hexadecimal digits, r, s and v")
    if digits != text:
        force_setattr(message, "signature", digits)


def _settle_hash(message: Struct, field: str, text: str) -> None:
    digits = _hex_digits(text, 32)
    if digits is None:
        raise InvalidMessage("hash", f"{field}: expected 64 hexadecimal digits")
    if digits != text:
        force_setattr(message, field, digits)


def _hex_digits(text: str, size: int) -> str | None:
    """The canonical digits of a text of `size` bytes, or None if it isn't one."""
    if text[:2] == "0x":
        text = text[2:]
    if len(text) != 2 * size:
        return None
    try:
        raw = bytes.fromhex(text)
    except ValueError:
        return None
    # bytes.fromhex() skips blanks: what has the right number of characters, but blanks among them, is too short here.
    return raw.hex() if len(raw) == size else None


def _refuse(message: Struct, error: InvalidCid | InvalidAddress) -> NoReturn:
    field = next(name for name in message.__struct_fields__ if getattr(message, name) == error.text)
    reason = "cid" if isinstance(error, InvalidCid) else "address"
    raise InvalidMessage(reason, f"{field}: {error}") from error
