"""Reading contracts: one function in one call, or many in one call, on any chain.

For many, the node runs code that is never deployed: the constructor of `contracts/src/Multicall.sol` makes the calls
and returns the answers instead of code. What a node does not answer that way is asked one by one.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeAlias

from mesh.chain.abi import our_functions
from mesh.chain.answers import InvalidAnswer, SpoiledAnswer, decode_values
from mesh.chain.artifacts import load_artifact
from mesh.chain.errors import NoContracts, RequestRefused, Reverted

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from mesh.chain.abi import ContractCall

    Call: TypeAlias = tuple[str, bytes]
    """An address and data."""

log = logging.getLogger(__name__)

READ_ATTEMPTS: Final = 3
"""How often a contract's function is called while what it returns does not decode."""

CALLS_AT_ONCE: Final = 100
"""Most calls in one: the creation code has 49,152 bytes at most (EIP-3860), and what it returns 24,576 (EIP-170)."""
UNLIMITED_GAS: Final = 2**256 - 1
LONGEST: Final = 0xFFFF
"""Bytes of an answer."""


def getters(contract: str, address: str, names: Iterable[str]) -> list[ContractCall]:
    """Calls of the getters `names` at an address that holds one of our contracts (`artifacts.NAMES`)."""
    functions = our_functions(contract)
    return [functions[name].at(address) for name in names]


class Caller(Protocol):
    """What reading needs of a node: see `Node`."""

    @property
    def chain_id(self) -> int: ...
    async def block_number(self) -> int: ...
    async def code(self, address: str, *, block: int | str = "latest") -> bytes: ...
    async def call(self, call: Mapping[str, Any], *, block: int | str = "latest") -> bytes: ...


async def read(node: Caller, call: ContractCall, *, block: int | str) -> Any:
    """See `Node.read`."""
    request = {"to": call.address, "data": "0x" + call.data.hex()}
    for attempt in range(READ_ATTEMPTS):
        returned = await node.call(request, block=block)
        try:
            return _decoded(call, returned)
        except SpoiledAnswer as error:
            failure = error
        if not attempt and not returned and not await node.code(call.address, block=block):
            raise NoContracts(f"contract with {call.fn_name} at {call.address}", node.chain_id)
    raise InvalidAnswer(f"{call.fn_name} of {call.address}", str(failure))


async def read_all(node: Caller, calls: Sequence[ContractCall], *, block: int | str) -> list[Any]:
    """See `Node.read_all`."""
    if block == "latest" and len(calls) > CALLS_AT_ONCE:
        block = await node.block_number()
    found: list[Any] = []
    for start in range(0, len(calls), CALLS_AT_ONCE):
        some = calls[start : start + CALLS_AT_ONCE]
        found += await _read_at_once(node, some, block) or await _read_each(node, some, block)
    return found


async def _read_at_once(node: Caller, calls: Sequence[ContractCall], block: int | str) -> list[Any] | None:
    """What the functions return; None if one of them fails, or the node refuses."""
    requests = [(call.address, call.data) for call in calls]
    try:
        answers = decode_answers(await node.call({"data": "0x" + encode_calls(requests).hex()}, block=block))
        return [_decoded(call, answer) for call, answer in zip(calls, answers, strict=True)]
    except (SpoiledAnswer, RequestRefused, Reverted, ValueError) as error:
        log.debug("%d functions are read one by one: %s", len(calls), error)
        return None


async def _read_each(node: Caller, calls: Sequence[ContractCall], block: int | str) -> list[Any]:
    number = await node.block_number() if block == "latest" and len(calls) > 1 else block
    answers = await asyncio.gather(*(read(node, call, block=number) for call in calls), return_exceptions=True)
    for answer in answers:
        if isinstance(answer, BaseException):
            raise answer
    return answers


def _decoded(call: ContractCall, returned: bytes | None) -> Any:
    """What a contract's function returned, several values as a tuple. Raises `SpoiledAnswer`."""
    if returned is None:
        raise SpoiledAnswer(f"{call.fn_name} failed")
    values = decode_values(call.outputs, returned)
    return values[0] if len(values) == 1 else values


async def call_all(node: Caller, calls: Sequence[Call], *, gas: int, most: int) -> list[bytes | None]:
    """What each call returns, `most` bytes of it, and None if it fails, also because it needs more than `gas`.

    Raises `Reverted` and `RequestRefused`, as when all calls together are too much for the node.
    """
    try:
        answers = decode_answers(await node.call({"data": "0x" + encode_calls(calls, gas=gas, most=most).hex()}))
    except SpoiledAnswer as error:
        raise InvalidAnswer(f"{len(calls)} calls in one", str(error)) from None
    if len(answers) != len(calls):
        raise InvalidAnswer(f"{len(calls)} calls in one", f"there are {len(answers)} answers")
    return answers


def encode_calls(calls: Sequence[Call], *, gas: int = UNLIMITED_GAS, most: int = LONGEST) -> bytes:
    """The creation code that makes the calls, each with at most `gas`, for at most `most` bytes of its answer."""
    packed = b"".join([bytes.fromhex(to[2:]) + len(data).to_bytes(2) + data for to, data in calls])
    words = b"".join([number.to_bytes(32) for number in (gas, most, 96, len(packed))])  # 96: where the length is
    return load_artifact("Multicall").bytecode + words + packed + bytes(-len(packed) % 32)


def decode_calls(code: bytes) -> list[Call] | None:
    """The calls that `encode_calls` encoded; None for other code. For nodes that imitate it."""
    known = load_artifact("Multicall").bytecode
    if not code.startswith(known):
        return None
    packed, calls, at = decode_values(["uint256", "uint256", "bytes"], code[len(known) :])[2], [], 0
    while at < len(packed):
        data = at + 22
        end = data + int.from_bytes(packed[at + 20 : data])
        calls.append(("0x" + packed[at : at + 20].hex(), packed[data:end]))
        at = end
    return calls


def encode_answers(answers: Sequence[bytes | None]) -> bytes:
    """What the code returns: of each call what it returned, or None if it failed."""
    return b"".join([bytes([one is not None]) + len(one or b"").to_bytes(2) + (one or b"") for one in answers])


def decode_answers(returned: bytes) -> list[bytes | None]:
    """The reverse of `encode_answers`. Raises `SpoiledAnswer`."""
    answers: list[bytes | None] = []
    at = 0
    while at < len(returned):
        data = at + 3
        end = data + int.from_bytes(returned[at + 1 : data])
        if end > len(returned) or returned[at] > 1:
            raise SpoiledAnswer("the answers to many calls are cut off")
        answers.append(returned[data:end] if returned[at] else None)
        at = end
    return answers
