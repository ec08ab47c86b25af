"""What an Ethereum node answers: the type of each answer, its limits, and why a contract reverted.

Nothing that a node says is used before it has its type: `decode_answer` raises `SpoiledAnswer` for a null, a missing
field or a value of another type, and then the request is sent again, to the next node if there are several.

Revert data is the 4-byte selector of an error and its ABI-encoded arguments: one of our custom errors, `Error(string)`
or `Panic(uint256)`. Geth, anvil and the embedded chain put it into the `data` of the JSON-RPC error, others deeper.
"""

from __future__ import annotations

import re
from functools import cache, lru_cache
from http import HTTPStatus
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

import msgspec
from eth_utils.abi import abi_to_signature, get_abi_input_types
from msgspec import Meta, Struct, structs
from msgspec.structs import force_setattr

from mesh.chain._abi import NAMES, SpoiledAnswer, decode, load_artifact
from mesh.chain.errors import RequestRefused, Reverted
from mesh.errors import ChainError
from schemas import keccak256
from schemas.address import checksum_address
from schemas.cid import format_cid
from schemas.errors import InvalidCid
from schemas.records import Liability

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping


class AnswerLimits(NamedTuple):
    """What is taken of one answer of a node."""

    size: int = 32 << 20
    """Bytes."""
    logs: int = 50_000
    """Logs in it."""
    text: int = 1_000
    """Characters of a text, such as an error message, that are kept."""


ANSWER_LIMITS: Final = AnswerLimits()

NO_TRANSACTIONS: Final = bytes.fromhex("56e81f171bcc55a6ff8345e692c0f86e5b48e01b996cadc001622fb5e363b421")
"""The root of an empty trie: a block without transactions has it."""
REVERTED: Final = 3
"""The JSON-RPC code that geth and anvil give to a call which the contract reverted."""
LOGS: Final = "eth_getLogs"
QUOTA_CODES: Final = frozenset({HTTPStatus.TOO_MANY_REQUESTS, -32005, -32007, -32016, -32029, -32097})
"""JSON-RPC errors of providers whose customer asks too much, where their texts don't speak of something else; some have
the status of HTTP."""
_QUOTA: Final = re.compile(
    r"rate.?limit|too many requests?|(?:request|call)s? (?:count|rate|limit)|/s(?:ec|econd)?\b|per second|quota|throttl"
    r"|compute units|\bRPS\b|over rate|credits|slow down"
    r"|(?:exceed\w*|over|out of|reached) .{0,40}(?:capacity|plan\b|daily|monthly)",
    re.IGNORECASE,
)
_OTHER_LIMIT: Final = re.compile(
    r"results|logs|range|response size|blocks?\b|\bgas\b|nonce|authori[sz]ed|balance|funds|fee\b", re.IGNORECASE
)
"""What texts with one of `QUOTA_CODES` are about, if not a quota: blocks and logs in an answer, a transaction."""
BEHIND: Final = re.compile(
    r"header not found|missing trie node|unknown block|block not found|header for hash not found|beyond (current )?head"
    r"|block #?\d+ (is )?not (found|available)|resource not found|state (is )?(not available|unavailable|missing)",
    re.IGNORECASE,
)
"""What a machine says that lacks a block, or its state, which another one behind the same address has."""
_REVERTED: Final = re.compile(
    r"execution (?:was )?reverted|(?:transaction|call) (?:was |has been )?reverted|vm (?:exception|error)\b.*\brevert"
    r"|\breverted with |contract[ _]revert|revert opcode|^reverted\b(?! to\b)|^(?:error: )?vm reverted|^revert$",
    re.IGNORECASE,
)
"""What nodes say of a call that a contract reverted: geth, Hardhat, Ganache, Hedera, Tron, Parity."""

LIABILITY_GETTERS: Final = (
    *("model", "objective", "result", "promisee", "promisor", "lighthouse", "lighthouseFee"),
    *("token", "cost", "validator", "validatorFee", "isSuccess", "isFinalized", "demandHash", "offerHash"),
)
"""The functions of a liability that return its record, and the hashes of its orders."""


RECORD_FIELDS: Final = structs.fields(Liability)
"""The fields of the record. In JSON, those that are read from a contract have the names of its functions."""


class OverQuota(ValueError):
    """The node answers later, or another one now: so many requests are more than it answers this customer.

    `wait` is how many seconds it asks to wait, 0 if it does not say.
    """

    def __init__(self, why: str, *, wait: float = 0.0) -> None:
        super().__init__(why)
        self.wait = wait


class InvalidAnswer(RequestRefused, code="invalid-answer"):
    """What a contract or a node returned does not fit the request, or is above a limit."""

    def __init__(self, what: str, why: str) -> None:
        ChainError.__init__(self, f"{what} returned what can't be used: {why}")
        self.method, self.rpc_code, self.detail = "eth_call", 0, why


class Quantity(int):
    """An amount, such as wei: 0x and up to 64 hexadecimal digits."""


class Count(int):
    """A number of blocks, transactions or units of gas: a quantity below 2**63."""


class Data(bytes):
    """Bytes: 0x and an even number of hexadecimal digits."""


class Word(bytes):
    """32 bytes, such as a hash."""


class Address(str):
    """An address, EIP-55."""

    __slots__ = ()


class _Answer(Struct, frozen=True, rename="camel"):
    """The base of answers; their fields hold plain ints, bytes and texts."""

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            force_setattr(self, name, _plain(getattr(self, name)))


LENGTHS: Final[Mapping[type, int]] = MappingProxyType({Word: 32, Address: 20})
"""Bytes of the types with a fixed length."""


class BlockHeader(_Answer, frozen=True):
    """A block. Hashes are 32 bytes, `timestamp` is Unix time, `base_fee` is wei (None: the chain has none).

    `may_log` is whether the block can hold a log, by its header.
    """

    number: Count
    hash: Word
    parent_hash: Word
    timestamp: Count
    base_fee: Quantity | None = msgspec.field(default=None, name="baseFeePerGas")
    transactions_root: Word | None = None
    logs_bloom: Data | None = None
    transactions: list[Word] | None = None
    """Their hashes; None in a header that the node has pushed."""

    @property
    def has_transactions(self) -> bool:
        """Whether the block holds transactions, as far as its header says."""
        return self.transactions_root != NO_TRANSACTIONS

    def may_hold(self, hashes: Iterable[str]) -> bool:
        """Whether one of these transactions may be in the block (0x and 64 hexadecimal digits)."""
        known = self.transactions
        return known is None or any(bytes.fromhex(tx[2:]) in known for tx in hashes)

    @property
    def has_bloom(self) -> bool:
        """Whether the Bloom filter says anything: some chains leave it out, or fill it with zeros or ones."""
        return bool(self.logs_bloom) and set(self.logs_bloom or b"") not in ({0}, {0xFF})

    def may_log(self, *alternatives: Iterable[bytes]) -> bool:
        """Whether the block may hold a log with all the members of one of the alternatives: its address and topics.

        False is certain; so is only what the node says of the block's logs.
        """
        if not self.has_transactions:
            return False
        if not self.has_bloom:
            return True
        bloom = int.from_bytes(self.logs_bloom or b"", "big")
        return any(all(bloom & bits == bits for bits in map(_bloom_bits, members)) for members in alternatives)


class Log(_Answer, frozen=True):
    """A log of a mined transaction."""

    address: Address
    topics: Annotated[list[Word], Meta(max_length=4)]
    data: Data
    block_number: Count
    block_hash: Word
    transaction_hash: Word
    log_index: Count


class MinedTransaction(_Answer, frozen=True):
    """The receipt of a transaction. `status` is 1 if it succeeded, `sender` is who paid its gas.

    Some nodes don't say at which price: then `effective_gas_price` is None. `l1_fee` is what OP-type rollups charge for
    the data of a transaction beside its gas, wei.
    """

    block_number: Count
    block_hash: Word
    gas_used: Count
    status: Count
    logs: Annotated[list[Log], Meta(max_length=ANSWER_LIMITS.logs)]
    effective_gas_price: Quantity | None = None
    sender: Address | None = msgspec.field(default=None, name="from")
    l1_fee: Quantity | None = None

    def wei(self, *, price: int | None = None) -> int | None:
        """What it has cost; `price` counts where the node does not say the price of gas, and None is not known."""
        paid = price if self.effective_gas_price is None else self.effective_gas_price
        return None if paid is None else self.gas_used * paid + (self.l1_fee or 0)


class BlockReceipt(_Answer, frozen=True):
    """What the receipt of a mined transaction says of its block and its logs."""

    block_hash: Word
    logs: Annotated[list[Log], Meta(max_length=ANSWER_LIMITS.logs)]


class BlockBody(_Answer, frozen=True):
    """The transactions of a block, by their hashes."""

    hash: Word
    transactions: list[Word]


class KnownTransaction(_Answer, frozen=True):
    """A transaction that the node has, mined or waiting."""

    hash: Word


class RpcFailure(Struct, frozen=True):
    """A JSON-RPC error."""

    code: int = 0
    message: str = ""
    data: Any = None


Text = Annotated[str, Meta(max_length=ANSWER_LIMITS.text)]

ANSWERS: Final[Mapping[str, Any]] = MappingProxyType(
    {
        "eth_blockNumber": Count,
        "eth_call": Data,
        "eth_chainId": Count,
        "eth_estimateGas": Count,
        "eth_gasPrice": Quantity,
        "eth_getBalance": Quantity,
        "eth_getBlockByHash": BlockBody | None,
        "eth_getBlockByNumber": BlockHeader | None,
        "eth_getBlockReceipts": list[BlockReceipt] | None,
        "eth_getCode": Data,
        "eth_getLogs": Annotated[list[Log], Meta(max_length=ANSWER_LIMITS.logs)],
        "eth_getTransactionByHash": KnownTransaction | None,
        "eth_getTransactionCount": Count,
        "eth_getTransactionReceipt": MinedTransaction | None,
        "eth_maxPriorityFeePerGas": Quantity,
        "eth_sendRawTransaction": Word,
        "eth_syncing": bool | dict[str, Any],
        "web3_clientVersion": Text,
    }
)
"""The type of the answer to each method that is used."""


def decode_answer(method: str, response: object, kind: Any = Any) -> Any:
    """The result in a node's JSON-RPC response, of a type of `ANSWERS`; or the `RpcFailure`. Raises `SpoiledAnswer`."""
    if not isinstance(response, dict):
        raise SpoiledAnswer(f"its answer to {method} is not an object")
    try:
        if response.get("error") is not None:
            return _passed_on(method, _failure(response["error"]))
        if "result" not in response:
            raise SpoiledAnswer(f"its answer to {method} holds no result")
        return _plain(msgspec.convert(response["result"], kind, dec_hook=_decode_value))
    except (msgspec.ValidationError, RecursionError) as error:
        raise SpoiledAnswer(f"its answer to {method} is invalid: {error}") from None


def liability_record(address: str, held: Mapping[str, Any]) -> Liability:
    """The record of a liability, by what its `LIABILITY_GETTERS` returned.

    CIDs are empty where the multihash is none: the originals take other bytes from anybody.
    """

    def cid(name: str) -> str:
        try:
            return format_cid(held[name])
        except InvalidCid:
            return ""

    fields = {field.name: held[field.encode_name] for field in RECORD_FIELDS if field.encode_name in held}
    return Liability(**fields | {"address": address} | {name: cid(name) for name in ("model", "objective", "result")})


@lru_cache(maxsize=1_024)
def _bloom_bits(member: bytes) -> int:
    """The bits of an address or topic in a block's Bloom filter: three, each by eleven bits of its hash."""
    digest = keccak256(member)
    return sum(1 << place for place in {int.from_bytes(digest[at : at + 2], "big") % 2_048 for at in (0, 2, 4)})


def _failure(error: object) -> RpcFailure:
    """The error of a response; some nodes give a text instead of an object."""
    if isinstance(error, str):
        return RpcFailure(message=error[: ANSWER_LIMITS.text])
    failure = msgspec.convert(error, RpcFailure)
    return RpcFailure(failure.code, failure.message[: ANSWER_LIMITS.text], failure.data)


def _passed_on(method: str, failure: RpcFailure) -> RpcFailure:
    """The error, if it is about the request. Raises `OverQuota`, `SpoiledAnswer` if it is about the node of now.

    Who reads logs knows what to do about a block that a machine lacks, and "limit exceeded" is what some nodes answer
    to every request for logs.
    """
    text = failure.message
    if says_reverted(failure):
        return failure
    is_known = failure.code in QUOTA_CODES and not _OTHER_LIMIT.search(text)
    if _QUOTA.search(text) or failure.code == HTTPStatus.TOO_MANY_REQUESTS or (is_known and method != LOGS):
        raise OverQuota(f"over its quota: {text}", wait=stated_wait(failure.data))
    if method != LOGS and BEHIND.search(text):
        raise SpoiledAnswer(f"it is behind: {text}")
    return failure


def says_reverted(failure: RpcFailure) -> bool:
    """Whether an error says that a contract reverted. Nodes also use the word for themselves and for blocks."""
    texts = (failure.message, failure.data if isinstance(failure.data, str) else "")
    return failure.code == REVERTED or any(_REVERTED.search(text) for text in texts)


def stated_wait(data: object) -> float:
    """The seconds to wait that a provider states in the data of its error; 0 if it states none."""
    found = data
    if isinstance(data, dict):
        found = data.get("backoff_seconds", data.get("retry_after"))
        if found is None:
            return next(
                (wait for inner in data.values() if isinstance(inner, dict) and (wait := stated_wait(inner))), 0.0
            )
    try:
        wait = float(found)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return 0.0
    return wait if 0 < wait < float("inf") else 0.0


def _decode_value(kind: type, value: object) -> Any:
    """A value as one of the types of this module."""
    if not isinstance(value, str) or not value.startswith("0x"):
        raise ValueError("expected 0x and hexadecimal digits")
    digits = value[2:]
    if digits and not (digits.isascii() and digits.isalnum()):  # int() and bytes.fromhex() accept more
        raise ValueError("expected hexadecimal digits")
    if kind is Quantity or kind is Count:
        if len(digits) > 64:
            raise ValueError("the number is too large")
        number = int(digits, 16)
        if kind is Count and number >> 63:
            raise ValueError("the number is too large")
        return kind(number)
    data = bytes.fromhex(digits)
    if len(data) != LENGTHS.get(kind, len(data)):
        raise ValueError(f"expected {LENGTHS[kind]} bytes")
    return Address(checksum_address(data)) if kind is Address else kind(data)


def _plain(value: Any) -> Any:
    """A value without the types of this module, which msgspec can't encode."""
    match value:
        case list():
            return [_plain(member) for member in value]
        case Quantity() | Count():
            return int(value)
        case Data() | Word():
            return bytes(value)
        case Address():
            return str(value)
    return value


PLAIN: Final = bytes.fromhex("08c379a0")
"""Selector of `Error(string)`, a revert with a text."""

PANIC: Final = bytes.fromhex("4e487b71")
"""Selector of `Panic(uint256)`, a failed assertion of the compiler."""


def decode_revert(failure: RpcFailure) -> Reverted | None:
    """The revert in a node's JSON-RPC error; None if it is another kind of error."""
    data = _revert_data(failure.data)
    if not says_reverted(failure) and (data or b"")[:4] not in {PLAIN, PANIC, *custom_errors()}:
        return None  # data alone proves nothing: nodes put other things there
    return explain(data or b"", message=failure.message)


def explain(data: bytes, *, message: str = "") -> Reverted:
    """The revert in revert data; `message` is the node's, for a revert without data."""
    selector, body = data[:4], data[4:]
    try:
        if selector == PLAIN:
            return Reverted(str(decode(["string"], body)[0])[: ANSWER_LIMITS.text], data=data)
        if selector == PANIC:
            return Reverted("Panic", arguments=decode(["uint256"], body), data=data)
        if selector in custom_errors():
            name, types = custom_errors()[selector]
            return Reverted(name, arguments=decode(types, body), data=data)
    except SpoiledAnswer:
        return Reverted("", data=data)
    _, _, reason = message.partition("execution reverted: ")
    return Reverted("" if data else reason, data=data)


@cache
def custom_errors() -> dict[bytes, tuple[str, list[str]]]:
    """Name and argument types of every custom error of our contracts, by selector."""
    errors = (entry for name in NAMES for entry in load_artifact(name).abi if entry["type"] == "error")
    return {
        keccak256(abi_to_signature(entry).encode())[:4]: (entry["name"], get_abi_input_types(entry)) for entry in errors
    }


def _revert_data(data: object) -> bytes | None:
    """The revert data, which nodes put in different places; None if there is none."""
    if isinstance(data, dict):
        data = data.get("data") or data.get("result")
    if not isinstance(data, str):
        return None
    _, found, digits = data.rpartition("0x")
    try:
        return bytes.fromhex(digits) if found else None
    except ValueError:
        return None
