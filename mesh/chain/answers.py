"""What an Ethereum node answers: the type of each answer, and its limits.

Nothing that a node says is used before it has its type: `decode_answer` raises `SpoiledAnswer` for a null, a missing
field or a value of another type, and then the request is sent again, to the next node if there are several.
"""

from __future__ import annotations

from functools import lru_cache
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Final

import msgspec
from msgspec import Meta, Struct
from msgspec.structs import force_setattr

from mesh.chain.abi import MalformedAbi, decode
from mesh.chain.errors import RequestRefused
from mesh.errors import ChainError
from schemas import keccak256
from schemas.address import checksum_address, parse_address
from schemas.cid import format_cid
from schemas.errors import InvalidCid
from schemas.records import Liability

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

MAX_ANSWER: Final = 32 << 20
"""Bytes of one answer."""
MAX_LOGS: Final = 50_000
"""Logs in one answer."""
NO_TRANSACTIONS: Final = bytes.fromhex("56e81f171bcc55a6ff8345e692c0f86e5b48e01b996cadc001622fb5e363b421")
"""The root of an empty trie: a block without transactions has it."""
BLOOM_BITS: Final = 2_048
LONGEST_TEXT: Final = 1_000
"""Characters of a text, such as an error message, that are kept."""
LIABILITY_GETTERS: Final = (
    *("model", "objective", "result", "promisee", "promisor", "lighthouse", "lighthouseFee"),
    *("token", "cost", "validator", "validatorFee", "isSuccess", "isFinalized", "demandHash", "offerHash"),
)
"""The functions of a liability that return its record, and the hashes of its orders."""


class SpoiledAnswer(ValueError):
    """An answer is not what its method returns. Asking again, or another node, may help."""


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

    @property
    def has_transactions(self) -> bool:
        """Whether the block holds transactions, as far as its header says."""
        return self.transactions_root != NO_TRANSACTIONS

    def may_log(self, *alternatives: Iterable[bytes]) -> bool:
        """Whether the block may hold a log with all the members of one of the alternatives: its address and topics.

        False is certain; so is only what the node says of the block's logs.
        """
        if not self.has_transactions:
            return False
        if self.logs_bloom is None or not any(self.logs_bloom):  # some chains don't fill it in
            return True
        bloom = int.from_bytes(self.logs_bloom, "big")
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
    """The receipt of a transaction. `status` is 1 if it succeeded."""

    block_number: Count
    block_hash: Word
    gas_used: Count
    effective_gas_price: Quantity
    status: Count
    logs: Annotated[list[Log], Meta(max_length=MAX_LOGS)]


class KnownTransaction(_Answer, frozen=True):
    """A transaction that the node has, mined or waiting."""

    hash: Word


class RpcFailure(Struct, frozen=True):
    """A JSON-RPC error."""

    code: int = 0
    message: str = ""
    data: Any = None


Text = Annotated[str, Meta(max_length=LONGEST_TEXT)]

ANSWERS: Final[Mapping[str, Any]] = MappingProxyType(
    {
        "eth_blockNumber": Count,
        "eth_call": Data,
        "eth_chainId": Count,
        "eth_estimateGas": Count,
        "eth_gasPrice": Quantity,
        "eth_getBalance": Quantity,
        "eth_getBlockByNumber": BlockHeader | None,
        "eth_getCode": Data,
        "eth_getLogs": Annotated[list[Log], Meta(max_length=MAX_LOGS)],
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
            return _failure(response["error"])
        if "result" not in response:
            raise SpoiledAnswer(f"its answer to {method} holds no result")
        return _plain(msgspec.convert(response["result"], kind, dec_hook=_decode_value))
    except (msgspec.ValidationError, RecursionError) as error:
        raise SpoiledAnswer(f"its answer to {method} is invalid: {error}") from None


def decode_values(types: Sequence[str], data: bytes) -> tuple[Any, ...]:
    """ABI-encoded values that a contract returned. Raises `SpoiledAnswer`."""
    try:
        return decode(types, data)
    except MalformedAbi as error:
        raise SpoiledAnswer(f"{len(data)} bytes are no {', '.join(types)}: {error}") from None


def decode_cid(data: bytes) -> str:
    """The CID of a multihash that a contract returned; empty for other bytes, which the originals take from anybody."""
    try:
        return format_cid(data)
    except InvalidCid:
        return ""


def liability_record(address: str, held: Mapping[str, Any]) -> Liability:
    """The record of a liability, by what its `LIABILITY_GETTERS` returned."""
    return Liability(
        address=address,
        model=decode_cid(held["model"]),
        objective=decode_cid(held["objective"]),
        result=decode_cid(held["result"]),
        promisee=parse_address(held["promisee"]),
        promisor=parse_address(held["promisor"]),
        lighthouse=parse_address(held["lighthouse"]),
        lighthouse_fee=held["lighthouseFee"],
        token=parse_address(held["token"]),
        cost=held["cost"],
        validator=parse_address(held["validator"]),
        validator_fee=held["validatorFee"],
        is_success=held["isSuccess"],
        is_finalized=held["isFinalized"],
    )


@lru_cache(maxsize=1_024)
def _bloom_bits(member: bytes) -> int:
    """The bits of an address or topic in a block's Bloom filter: three, each by eleven bits of its hash."""
    digest = keccak256(member)
    return sum(1 << place for place in {int.from_bytes(digest[at : at + 2], "big") % BLOOM_BITS for at in (0, 2, 4)})


def _failure(error: object) -> RpcFailure:
    """The error of a response; some nodes give a text instead of an object."""
    if isinstance(error, str):
        return RpcFailure(message=error[:LONGEST_TEXT])
    failure = msgspec.convert(error, RpcFailure)
    return RpcFailure(failure.code, failure.message[:LONGEST_TEXT], failure.data)


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
