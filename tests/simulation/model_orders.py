"""Orders, terms and signatures of the modelled contracts (`Orders.sol`, `Terms.sol`, `Signatures.sol`)."""

from __future__ import annotations

from functools import lru_cache
from typing import Final, NamedTuple

from schemas import InvalidMessage, keccak256
from schemas.address import address_bytes
from schemas.signing import recover_keys, signer_of
from tests.simulation.model_abi import refused, word
from tests.simulation.model_contracts import NOBODY, stand_in

MULTIHASH: Final = bytes.fromhex("1220")
SIGNATURE: Final = 65
"""Bytes."""
HALF_ORDER: Final = 0x7FFFFFFFFFFFFFFFFFFFFFFFFFFFFFFF5D576E7357A4501DDFE92F46681B20A0


class ModelTerms(NamedTuple):
    """What promisee and promisor agreed on."""

    generation: int
    model: bytes
    objective: bytes
    promisee: bytes
    promisor: bytes
    lighthouse: bytes
    token: bytes
    validator: bytes
    cost: int
    lighthouse_fee: int
    validator_fee: int
    created_at: int
    demand: tuple[bytes, int, int]
    """Hash, deadline and nonce."""
    offer: tuple[bytes, int, int]

    def pack(self, xrt: bytes) -> bytes:
        """The bytes behind the clone's code."""
        flags = (self.generation == 3) | (self.token != xrt) << 1 | (self.validator != NOBODY) << 2
        amounts = (self.cost, self.lighthouse_fee, self.validator_fee)
        for bit, amount in enumerate(amounts, start=3):
            flags |= (amount != 0) << bit
        packed = self.model + self.objective + self.promisee + self.promisor + self.lighthouse + bytes([flags])
        packed += self.token if self.token != xrt else b""
        packed += self.validator if self.validator != NOBODY else b""
        packed += b"".join(_number(amount) for amount in amounts if amount) + _number(self.created_at)
        if self.generation == 3:
            return packed + self.demand[0] + self.offer[0]
        deadlines = (self.demand[1] - self.created_at, self.offer[1] - self.created_at)
        return packed + b"".join(map(_number, (*deadlines, self.demand[2], self.offer[2])))


class ModelOrder(NamedTuple):
    """An order as the words of its canonical encoding."""

    words: tuple[int, ...]
    data: bytes

    @property
    def is_fifth(self) -> bool:
        """Whether its ninth word is an address."""
        return self.words[8] >> 160 == 0

    def address(self, index: int) -> bytes:
        """A word as an address."""
        return self.words[index].to_bytes(20, "big")

    def digest(self, index: int) -> bytes:
        """The last 32 of the 34 bytes that begin with a word."""
        return self.data[32 * index + 2 : 32 * index + 34]

    def hash(self, nonce: int) -> bytes:
        """What was signed; the nonce is of generation 5."""
        data = self.data
        packed = data[352:386] + data[448:482] + data[76:128] + data[140:160] + data[172:256]
        if self.is_fifth:
            return keccak256(packed + word(nonce) + self.address(8))
        return keccak256(packed + data[256:288])

    def signer(self, digest: bytes) -> bytes:
        """Who signed it."""
        return recover_signer(digest, self.data[544:609])


def read_order(data: bytes) -> ModelOrder:
    """The order in the data, which must be its canonical encoding."""
    if len(data) != 640:
        raise refused("MalformedOrder")
    words = tuple(int.from_bytes(data[at : at + 32], "big") for at in range(0, 640, 32))
    is_laid_out = (words[0], words[1], words[9], words[10], words[13], words[16]) == (320, 416, 512, 34, 34, 65)
    are_multihashes = data[352:354] == data[448:450] == MULTIHASH
    is_padded = not any(data[386:416]) and not any(data[482:512]) and not any(data[609:640])
    are_addresses = not (words[2] | words[4] | words[5]) >> 160
    if not (is_laid_out and are_multihashes and is_padded and are_addresses):
        raise refused("MalformedOrder")
    return ModelOrder(words, data)


def require_match(demand: ModelOrder, offer: ModelOrder) -> None:
    """Both orders must be about the same work on the same terms."""
    for name, is_same in (
        ("GenerationMismatch", demand.is_fifth == offer.is_fifth),
        ("ModelMismatch", demand.digest(11) == offer.digest(11)),
        ("ObjectiveMismatch", demand.digest(14) == offer.digest(14)),
        ("TokenMismatch", demand.words[2] == offer.words[2]),
        ("CostMismatch", demand.words[3] == offer.words[3]),
        ("LighthouseMismatch", demand.words[4] == offer.words[5]),
        ("ValidatorMismatch", demand.words[5] == offer.words[4]),
    ):
        if not is_same:
            raise refused(name)


def read_result(liability: bytes, result: bytes, success: bool) -> tuple[bytes, bytes]:
    """The digest of a result, and what its signers sign."""
    if len(result) != 34 or result[:2] != MULTIHASH or int.from_bytes(result[2:], "big") <= 1:
        raise refused("MalformedResult")
    return result[2:], keccak256(liability + result + bytes([success]))


def require_signer(expected: bytes, signer: bytes) -> None:
    """The signer must be the one expected."""
    if signer != expected:
        raise refused("WrongSigner", expected, signer)


def recover_signer(digest: bytes, signature: bytes) -> bytes:
    """Who signed a hash."""
    signer = _signer_of(digest, signature)
    if signer is None:
        raise refused("InvalidSignature")
    return signer


def recover_signers(digest: bytes, signatures: bytes) -> bytes:
    """Who signed a hash, or the address that stands for several signers."""
    if len(signatures) <= SIGNATURE:
        return recover_signer(digest, signatures)
    if len(signatures) % SIGNATURE:
        raise refused("InvalidSignature")
    signers = [NOBODY]
    for at in range(0, len(signatures), SIGNATURE):
        signer = recover_signer(digest, signatures[at : at + SIGNATURE])
        if signer <= signers[-1]:
            raise refused("SignersOutOfOrder", signers[-1], signer)
        signers.append(signer)
    return stand_in(signers[1:])


@lru_cache(maxsize=10_000)
def _signer_of(digest: bytes, signature: bytes) -> bytes | None:
    """Who signed a hash as EIP-191 has it; None for nobody."""
    if (
        len(signature) != SIGNATURE
        or int.from_bytes(signature[32:64], "big") > HALF_ORDER
        or signature[64] not in (27, 28)
    ):
        return None
    prefixed = keccak256(b"\x19Ethereum Signed Message:\n32" + digest)
    try:
        return address_bytes(signer_of(recover_keys([(prefixed, signature, signature[64] - 27)])[0]))
    except InvalidMessage:
        return None


def _number(value: int) -> bytes:
    size = -(-value.bit_length() // 8)
    return bytes([size]) + value.to_bytes(size, "big")
