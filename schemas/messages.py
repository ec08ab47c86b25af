"""The messages of a market: what they are, the JSON that travels, the hash that is signed, and what the contracts take.

Every message object is well-formed: the constructors check each field, bring it to its canonical form (addresses in
EIP-55, ENS names and hexadecimal digits in lower case and without `0x`) and raise `InvalidMessage` for what is wrong.
They don't verify the signature; `schemas.signing` does. A message is hashed with addresses only: collect its ENS names
with `names_in`, look them up on a chain, and replace them with `resolve_names`.

Reading JSON is strict: unknown, repeated and missing fields, fractions where integers belong, and texts that are not
quite addresses, names or hashes are rejected with a reason. Writing is canonical: compact, no `0x` on nonces and
signatures. Hashes and contract bytes are Solidity's `abi.encodePacked` and `abi.encode`, written out field by field.

What a new kind of message needs is in docs/explanation/architecture.md.

Amounts are integers of at most 256 bits: `cost` in the token's smallest unit, fees in wn (10^-9 XRT), `deadline` is a
block number (the order is valid while `block.number < deadline`). Source: the wire format of the legacy network.
"""

from __future__ import annotations

from functools import lru_cache
from struct import Struct as Layout
from sys import intern
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, NoReturn, TypeAlias, TypeVar, final

import msgspec
from msgspec import Struct
from msgspec.structs import force_setattr, replace

from schemas.address import address_bytes, keccak256, parse_address, parse_address_or_name
from schemas.cid import CACHED, CID_LENGTH, parse_ahead, parse_cid
from schemas.decoding import InvalidData, decode_json
from schemas.errors import InvalidAddress, InvalidCid, InvalidMessage
from schemas.keys import MarketKind  # msgspec reads the annotations
from schemas.records import MAX_UINT256

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping


SIGNATURE_SIZE: Final = 65


def set_address(message: Struct, field: str, text: str) -> None:
    # The cached text replaces the equal one, so that an address in a million open orders is in memory once.
    canonical = parse_address_or_name(text)
    if canonical is not text:
        force_setattr(message, field, canonical)


def check_uint256(field: str, value: int) -> None:
    if type(value) is not int:
        raise InvalidMessage("field", f"{field}: expected an integer")
    if not 0 <= value <= MAX_UINT256:
        raise InvalidMessage("range", f"{field}: expected an integer from 0 to 2^256-1")


def are_uint256(first: int, second: int, third: int) -> bool:
    """Whether `check_uint256` accepts three values: one check for all is the fastest."""
    return type(first) is type(second) is type(third) is int and not (first | second | third) >> 256


def set_signature(message: Struct, text: str) -> None:
    if not text:
        return
    digits = hex_digits(text, SIGNATURE_SIZE)
    if digits is None:
        raise InvalidMessage("signature", "a signature is 130 hexadecimal digits, r, s and v")
    if digits != text:
        force_setattr(message, "signature", digits)


def set_hash(message: Struct, field: str, text: str) -> None:
    digits = hex_digits(text, 32)
    if digits is None:
        raise InvalidMessage("hash", f"{field}: expected 64 hexadecimal digits")
    if digits != text:
        force_setattr(message, field, digits)


def are_canonical(*digits: str) -> bool:
    """Whether texts are hexadecimal digits as `hex_digits` returns them: one check for all is the fastest."""
    joined = "".join(digits)
    try:
        return bytes.fromhex(joined).hex() == joined
    except ValueError:
        return False


def hex_digits(text: str, size: int) -> str | None:
    """The canonical hexadecimal digits of `size` bytes, or None if `text` is something else."""
    if text[:2] == "0x":
        text = text[2:]
    if len(text) != 2 * size:
        return None
    try:
        raw = bytes.fromhex(text)
    except ValueError:
        return None
    # bytes.fromhex() skips blanks, so a text with blanks among its characters is too short here.
    return raw.hex() if len(raw) == size else None


_NO_NAMES: Final[frozenset[str]] = frozenset()


@lru_cache(maxsize=CACHED)
def _market_fields(model: str, token: str, lighthouse: str, validator: str) -> tuple[str, str, str, str]:
    """The canonical texts of what most orders of a market have in common: checked once, and in memory once."""
    parse_cid(model)
    token, lighthouse, validator = (parse_address_or_name(text) for text in (token, lighthouse, validator))
    if validator == lighthouse:
        # With the two exchanged, an offer is a demand with the same signature: see mesh/chain/_validators.py.
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
    is_of_lighthouse: ClassVar[bool] = False
    """Whether it has a `lighthouse` and a `deadline`, which a market checks."""
    is_order: ClassVar[bool] = False
    """Whether it has a nonce and a validator besides, which a market checks, too."""
    is_typed_data: ClassVar[bool] = False
    """Whether its signature is one of EIP-712, which covers its hash as it is; else it is a personal message."""

    @property
    def key_model(self) -> str:
        """The model that its key names; empty for all but orders."""
        return ""


class _Order(_Message, frozen=True, kw_only=True, rename="camel"):
    """The fields that a Demand and an Offer have in common."""

    address_fields: ClassVar[tuple[str, ...]] = ("token", "lighthouse", "validator", "sender")
    is_of_lighthouse: ClassVar[bool] = True
    is_order: ClassVar[bool] = True

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
    is_of_lighthouse: ClassVar[bool] = True

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


@final
class Permit(_Message, frozen=True, kw_only=True):
    """An owner's approval (EIP-2612) that `spender` may take `value` of `token`, which anybody may bring to the token.

    A promisee publishes one beside a demand, for the factory, so that it needs no transaction and no ether. It replaces
    the allowance, and is for no particular demand. `value` is in the token's smallest unit, `nonce` the token's
    `nonces(owner)`, `deadline` the last second (Unix time) in which the token takes it, `domain` the token's
    `DOMAIN_SEPARATOR`: 64 hexadecimal digits. Whether nonce and domain are the token's, only the chain can tell: the
    signature covers the domain, not `token`.
    """

    kind: ClassVar[MarketKind] = "permit"
    mark: ClassVar[str] = "spender"
    address_fields: ClassVar[tuple[str, ...]] = ("owner", "spender", "token")
    is_typed_data: ClassVar[bool] = True

    owner: str
    spender: str
    token: str
    value: int
    nonce: int
    deadline: int
    domain: str
    signature: str = ""

    def __post_init__(self) -> None:
        try:
            for field in self.address_fields:
                set_address(self, field, getattr(self, field))
        except InvalidAddress as error:
            _raise_invalid(self, error)
        for field in ("value", "nonce", "deadline"):
            check_uint256(field, getattr(self, field))
        set_hash(self, "domain", self.domain)
        set_signature(self, self.signature)


Order: TypeAlias = Demand | Offer
SignedMessage: TypeAlias = Demand | Offer | Withdrawal | Result | Permit
Message: TypeAlias = SignedMessage | OrderFeedback | TransactionFeedback

MESSAGE_TYPES: Final[tuple[type[Message], ...]] = (
    Demand,
    Offer,
    OrderFeedback,
    TransactionFeedback,
    Result,
    Withdrawal,
    Permit,
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


MAX_MESSAGE_SIZE: Final = 16_384
"""The longest payload, in bytes, that is decoded. Real messages have about 700."""

_TYPE_OF_MARK: Final[dict[str, type[Message]]] = {one.mark: one for one in MESSAGE_TYPES}
_MARKS: Final = tuple((f'"{mark}":'.encode(), one) for mark, one in _TYPE_OF_MARK.items())
_FIELDS: Final = {one: msgspec.structs.fields(one) for one in MESSAGE_TYPES}
_FIELD_COUNTS: Final = {one: len(fields) for one, fields in _FIELDS.items()}
_NEW_CIDS: Final[dict[type[Any], bytes]] = {Demand: b'"objective":"', Offer: b'"objective":"', Result: b'"result":"'}
"""What stands before the CID of a message that no other message has."""
_ENCODER: Final = msgspec.json.Encoder()

_WORD: Final = 32
_MAX_UINT64: Final = 2**64 - 1
_SMALL_ORDER: Final = Layout(">34s34s20s24xQ20s20s24xQ24xQ")
"""What the hash of an order covers up to its nonce, if no number has more than 64 bits: in one step, so faster."""
_TWELVE_ZEROS: Final = bytes(12)
_WITHDRAWAL_TYPE: Final = keccak256(b"Withdrawal(bytes32 order,address lighthouse,uint256 deadline)")
"""The first word of what a withdrawal's signature covers; no order and no Result begins like this."""
_PERMIT_TYPE: Final = keccak256(b"Permit(address owner,address spender,uint256 value,uint256 nonce,uint256 deadline)")
"""The first word of a permit's fields (EIP-2612)."""


def decode(payload: bytes, likely: type[Any] | None = None) -> Message:
    """The message in `payload`, checked and in canonical form; its signature is present, but not verified.

    It is decoded sooner if it is of the `likely` kind. Raises `InvalidMessage` and nothing else, whatever the bytes
    are. Its `reason` is one of `too-large`, `not-json`, `unknown-kind`, `unknown-field`, `duplicate-field`, `field`
    (missing or of the wrong type), `address`, `cid`, `nonce`, `range`, `hash`, `validator` (an order's lighthouse) and
    `signature`.
    """
    if len(payload) > MAX_MESSAGE_SIZE:
        raise InvalidMessage("too-large", f"it has {len(payload)} bytes; the limit is {MAX_MESSAGE_SIZE}")
    message_type: type[Message] = likely or _type_of(payload)
    try:
        message = decode_json(payload, message_type)
    except InvalidData as error:
        if likely is not None:
            return decode(payload)
        if error.reason == "type":
            _explain(payload, message_type, str(error))
        raise InvalidMessage("not-json", str(error)) from None
    count = _FIELD_COUNTS[message_type]
    # Not `isinstance`, which is slow when it fails.
    if (type(message) is Demand or type(message) is Offer) and message.sender is None:
        count -= 1
    if getattr(message, "signature", None) == "":
        _explain(payload, message_type, "the signature is empty", reason="signature")
    # The decoder takes the last of repeated fields. No value of a well-formed message contains a colon, so there is
    # one colon per field; any more belong to repeated fields.
    if payload.count(b":") != count:
        _explain(payload, message_type, "a field is repeated", reason="duplicate-field")
    return message


def parse_cids_ahead(payloads: Iterable[bytes], likely: type[Any]) -> None:
    """Parse together what is new in each payload, its CID: `decode` of those of the `likely` kind is faster then."""
    mark = _NEW_CIDS.get(likely)
    if mark is None:
        return
    starts = [(payload, payload.find(mark) + len(mark)) for payload in payloads]
    texts = [payload[start : start + CID_LENGTH] for payload, start in starts if start >= len(mark)]
    if len(texts) >= 8:  # fewer are as fast one by one
        parse_ahead([text.decode("ascii", "replace") for text in texts])


def encode(message: Message) -> bytes:
    """The compact JSON of a message, with exactly the fields that the legacy network knows.

    Raises `InvalidMessage` (`signature`) if the message should be signed and is not.
    """
    if not isinstance(message, TransactionFeedback) and not message.signature:
        raise InvalidMessage("signature", "the message is not signed; sign it before it travels")
    return _ENCODER.encode(message)


class MessageHash(bytes):
    """The 32 bytes of a message's hash, which print as hexadecimal digits."""

    __slots__ = ()

    def __str__(self) -> str:
        return self.hex()

    __repr__ = __str__


def message_hash(message: Message) -> MessageHash:
    """The 32-byte hash that names a message and that its signature covers: keccak256 of the packed fields.

    Raises `InvalidMessage`: `unresolved-name` if an address is still an ENS name, `unsigned` for the feedback messages,
    for which no hash is defined.
    """
    pack = _PACKERS.get(type(message))
    if pack is None:
        raise InvalidMessage("unsigned", f"what is signed in a {type(message).__name__} is not defined")
    try:
        return MessageHash(keccak256(pack(message)))
    except InvalidAddress as error:
        raise _unresolved(error) from None


def equal_terms(order: Demand | Offer) -> tuple[str, str, str, int, str, int]:
    """What a demand and an offer of one lighthouse must have in common to match."""
    return (order.model, order.objective, order.token, order.cost, order.validator, order.generation)


def lasting_hash(order: Demand | Offer) -> str:
    """What all versions of an order share: in generation 5 its hash without the nonce, otherwise its hash."""
    return message_hash(order if order.generation == 3 else replace(order, nonce=0)).hex()


def cancellation_hash(liability: str) -> bytes:
    """The 32-byte hash that both parties sign to cancel the liability at this address, each with `Signer.sign_hash`.

    It is the keccak256 of the address and the six letters `cancel`: 26 bytes, a length that no message has. Raises
    `InvalidAddress`.
    """
    return keccak256(address_bytes(liability) + b"cancel")


def order_abi(order: Order) -> bytes:
    """The plain `abi.encode` of a signed order's fields: what `createLiability` takes for a demand or an offer.

    Generation 3 carries its nonce in the ninth place, generation 5 its sender, and contracts tell them apart by the
    twelve zero bytes before an address. Raises `InvalidMessage`: `signature` if the order is not signed,
    `unresolved-name`, or `nonce` if a generation-3 nonce would be taken for an address.
    """
    if not order.signature:
        raise InvalidMessage("signature", "the order is not signed")
    try:
        ninth = _ninth_word(order)
        model, objective, token, cost, first, second, fee, deadline = _terms(order)
    except InvalidAddress as error:
        raise _unresolved(error) from None
    tails = [_abi_bytes(content) for content in (model, objective, bytes.fromhex(order.signature))]
    model_at = 10 * _WORD
    objective_at = model_at + len(tails[0])
    signature_at = objective_at + len(tails[1])
    head = (
        _word(model_at),
        _word(objective_at),
        _padded(token),
        _word(cost),
        _padded(first),
        _padded(second),
        _word(fee),
        _word(deadline),
        ninth,
        _word(signature_at),
    )
    return b"".join((*head, *tails))


def _type_of(payload: bytes) -> type[Message]:
    # No text of a well-formed message contains a quotation mark, so a mark before a colon is a key. A writer may spell
    # keys with escapes, or with spaces behind them; then none is found and the object is parsed.
    for mark, message_type in _MARKS:
        if mark in payload:
            return message_type
    present = _fields_of(payload)
    for field, message_type in _TYPE_OF_MARK.items():
        if field in present:
            return message_type
    raise InvalidMessage("unknown-kind", f"none of {', '.join(_TYPE_OF_MARK)} is present")


def _fields_of(payload: bytes) -> dict[str, msgspec.Raw]:
    try:
        return decode_json(payload, dict[str, msgspec.Raw])
    except InvalidData as error:
        is_list = payload.lstrip().startswith(b"[")
        raise InvalidMessage("unknown-kind" if is_list or error.reason == "type" else "not-json", str(error)) from None


def _explain(payload: bytes, message_type: type[Message], detail: str, *, reason: str = "field") -> NoReturn:
    """Raise `InvalidMessage` with our own reason why `payload` is no message; not on the hot path."""
    present = _fields_of(payload)
    if "validatorFee" in present and "lighthouseFee" in present:
        raise InvalidMessage("unknown-kind", "it has both validatorFee and lighthouseFee")
    fields = _FIELDS[message_type]
    unknown = present.keys() - {field.encode_name for field in fields}
    if unknown:
        names = ", ".join(map(repr, sorted(unknown)))
        raise InvalidMessage("unknown-field", f"a {message_type.__name__} has no {names}"[:200])
    wanted = {field.encode_name for field in fields if field.name != "sender"}
    if missing := wanted - present.keys():
        raise InvalidMessage("field", f"{', '.join(sorted(missing))} missing")
    if bytes(present.get("sender", b"")) == b"null":
        raise InvalidMessage("field", "sender: expected an address")
    raise InvalidMessage(reason, detail)


def _terms(order: Order) -> tuple[bytes, bytes, bytes, int, bytes, bytes, int, int]:
    """What a hash and a contract take of an order up to its nonce, in their order: they read an offer as a demand
    whose lighthouse and validator are exchanged.
    """
    first, second = address_bytes(order.lighthouse), address_bytes(order.validator)
    if isinstance(order, Demand):
        fee = order.validator_fee
    else:
        first, second, fee = second, first, order.lighthouse_fee
    model, objective, token = parse_cid(order.model), parse_cid(order.objective), address_bytes(order.token)
    return model, objective, token, order.cost, first, second, fee, order.deadline


def _pack_order(message: Order) -> bytes:
    terms = _terms(message)
    if message.sender is None:
        tail = bytes.fromhex(message.nonce)  # type: ignore[arg-type]  # a text in generation 3
    else:
        tail = _word(message.nonce) + address_bytes(message.sender)  # type: ignore[arg-type]
    model, objective, token, cost, first, second, fee, deadline = terms
    if cost <= _MAX_UINT64 and fee <= _MAX_UINT64 and deadline <= _MAX_UINT64:
        return _SMALL_ORDER.pack(*terms) + tail
    return b"".join((model, objective, token, _word(cost), first, second, _word(fee), _word(deadline), tail))


def _pack_result(message: Result) -> bytes:
    return address_bytes(message.liability) + parse_cid(message.result) + (b"\1" if message.success else b"\0")


def _pack_withdrawal(message: Withdrawal) -> bytes:
    lighthouse = _padded(address_bytes(message.lighthouse))
    return b"".join((_WITHDRAWAL_TYPE, bytes.fromhex(message.order), lighthouse, _word(message.deadline)))


def _pack_permit(message: Permit) -> bytes:
    owner, spender = (_padded(address_bytes(address)) for address in (message.owner, message.spender))
    numbers = (_word(number) for number in (message.value, message.nonce, message.deadline))
    fields = keccak256(b"".join((_PERMIT_TYPE, owner, spender, *numbers)))
    return b"\x19\x01" + bytes.fromhex(message.domain) + fields


_PACKERS: Final[dict[type[Message], Callable[[Any], bytes]]] = {
    Demand: _pack_order,
    Offer: _pack_order,
    Withdrawal: _pack_withdrawal,
    Result: _pack_result,
    Permit: _pack_permit,
}
"""What the hash of a message covers, by its type; for the feedback messages it is not defined."""


def _ninth_word(order: Order) -> bytes:
    if order.sender is not None:
        return _padded(address_bytes(order.sender))
    nonce = bytes.fromhex(order.nonce)  # type: ignore[arg-type]  # a text in generation 3
    if nonce.startswith(_TWELVE_ZEROS):
        raise InvalidMessage("nonce", "twelve leading zero bytes would make a contract take the nonce for a sender")
    return nonce


def _word(value: int) -> bytes:
    return value.to_bytes(_WORD, "big")


def _padded(address: bytes) -> bytes:
    return _TWELVE_ZEROS + address


def _abi_bytes(data: bytes) -> bytes:
    return _word(len(data)) + data + bytes(-len(data) % _WORD)


def _unresolved(error: InvalidAddress) -> InvalidMessage:
    # An address field of a message holds an address or a name, so a text that is no address is a name.
    return InvalidMessage("unresolved-name", f"{error.text} has to be resolved to an address first")
