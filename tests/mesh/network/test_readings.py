"""No signature of one kind of message is valid as another kind, whatever its fields are.

What a signature covers has no tag for the kind, so the same bytes can be read as each kind whose fields fill as many
bytes. A demand and an offer do: they have lighthouse and validator in swapped places. A permit is typed data, which is
signed with another prefix.
"""

from __future__ import annotations

from typing import Any, Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mesh.network import MarketRules, MessageValidator, message_key
from mesh.network._validation import Unresolved
from schemas import (
    ZERO_ADDRESS,
    AiraError,
    Demand,
    Offer,
    Result,
    SignedMessage,
    Signer,
    Withdrawal,
    address_bytes,
    cancellation_hash,
    checksum_address,
    cid_of_digest,
    encode,
    format_cid,
    keccak256,
    message_hash,
    parse_cid,
    recover,
)
from schemas.signing import Rejection
from tests.support.network.validating import check_payload
from tests.support.orders import MARKET

LIGHTHOUSES: Final = tuple(checksum_address(bytes([number]) * 20) for number in (0x11, 0x12, 0x13))
ACCOUNTS: Final = (ZERO_ADDRESS, *(checksum_address(bytes([number]) * 20) for number in (0x21, 0x22)))
SIGNER: Final = Signer(b"\x07" * 32)
ORDER_START: Final = (("model", 34), ("objective", 34), ("token", 20), ("cost", 32))
ORDER_END: Final = (("deadline", 32), ("nonce", 32))
DEMAND_FIELDS: Final = (*ORDER_START, ("lighthouse", 20), ("validator", 20), ("validator_fee", 32), *ORDER_END)
OFFER_FIELDS: Final = (*ORDER_START, ("validator", 20), ("lighthouse", 20), ("lighthouse_fee", 32), *ORDER_END)
FIELDS: Final[dict[tuple[type[SignedMessage], int], tuple[tuple[str, int], ...]]] = {
    (Demand, 3): DEMAND_FIELDS,
    (Demand, 5): (*DEMAND_FIELDS, ("sender", 20)),
    (Offer, 3): OFFER_FIELDS,
    (Offer, 5): (*OFFER_FIELDS, ("sender", 20)),
    (Withdrawal, 0): (("type", 32), ("order", 32), ("zeros", 12), ("lighthouse", 20), ("deadline", 32)),
    (Result, 0): (("liability", 20), ("result", 34), ("success", 1)),
}
"""What the signature of each kind and generation covers, but of permits: names and sizes of fields."""
WITHDRAWAL_TYPE: Final = keccak256(b"Withdrawal(bytes32 order,address lighthouse,uint256 deadline)")


def generation_of(message: SignedMessage) -> int:
    return message.generation if isinstance(message, Demand | Offer) else 0


def covered(message: SignedMessage) -> bytes:
    """The bytes whose hash is signed."""

    def part(name: str, size: int) -> bytes:
        value = {"type": WITHDRAWAL_TYPE, "zeros": bytes(12)}.get(name) or getattr(message, name)
        match value:
            case bytes():
                return value
            case str() if size == 34:
                return parse_cid(value)
            case str() if size == 20:
                return address_bytes(value)
            case str():
                return bytes.fromhex(value)
        return int(value).to_bytes(size, "big")

    return b"".join(part(name, size) for name, size in FIELDS[type(message), generation_of(message)])


def reading(data: bytes, kind: type[SignedMessage], generation: int) -> SignedMessage | None:
    """The message of that kind whose signature covers these bytes, if there is one."""
    fields: dict[str, Any] = {}
    for name, size in FIELDS[kind, generation]:
        part, data = data[:size], data[size:]
        if name == "success":
            fields[name] = {b"\0": False, b"\1": True}.get(part, part)
        elif size == 34 or size == 20:
            fields[name] = part
        else:
            is_text = name == "order" or (name == "nonce" and generation == 3)
            fields[name] = part.hex() if is_text else int.from_bytes(part, "big")
        if len(part) != size:
            return None
    if data or fields.pop("type", WITHDRAWAL_TYPE) not in (WITHDRAWAL_TYPE, int.from_bytes(WITHDRAWAL_TYPE, "big")):
        return None
    if fields.pop("zeros", 0) != 0:
        return None
    try:
        for name, size in FIELDS[kind, generation]:
            if size in (20, 34) and name in fields:
                fields[name] = checksum_address(fields[name]) if size == 20 else format_cid(fields[name])
        return kind(**fields)
    except AiraError:
        return None


class Factory:
    """A factory that knows its lighthouses."""

    def __init__(self, *lighthouses: str) -> None:
        self._lighthouses = lighthouses

    def known(self, validator: str) -> bool:
        return validator not in self._lighthouses

    async def is_safe(self, validator: str) -> bool:
        return self.known(validator)


def is_accepted(message: SignedMessage, *, factory: Factory | None) -> bool:
    """Whether an agent or a provider of any lighthouse accepts the signed message."""
    for lighthouse in LIGHTHOUSES:
        validator = MessageValidator(type(message), MarketRules(MARKET, address=lighthouse, validators=factory))
        accepted = check_payload(validator, message_key(MARKET, message), encode(message))
        assert not isinstance(accepted, Unresolved)
        if accepted is not None:
            return True
    return False


addresses = st.sampled_from(LIGHTHOUSES) | st.sampled_from((*ACCOUNTS, SIGNER.address))
cids = st.binary(min_size=32, max_size=32).map(cid_of_digest)
hashes = st.binary(min_size=32, max_size=32).map(bytes.hex)
amounts = st.integers(1, 3) | st.integers(0, 2**256 - 1)


@st.composite
def signed(draw: st.DrawFn) -> SignedMessage:
    """A signed message of any kind, whose addresses are lighthouses and accounts in any order."""
    kind, generation = draw(st.sampled_from(list(FIELDS)))
    fields: dict[str, Any] = {}
    for name, size in FIELDS[kind, generation]:
        if name in ("type", "zeros"):
            continue
        if name == "sender":
            fields[name] = SIGNER.address
        elif name == "success":
            fields[name] = draw(st.booleans())
        elif name == "order" or (name == "nonce" and generation == 3):
            fields[name] = draw(hashes)
        else:
            fields[name] = draw({20: addresses, 34: cids, 32: amounts}[size])
    if fields.get("validator", "") == fields.get("lighthouse"):
        fields |= {"lighthouse": LIGHTHOUSES[0], "validator": LIGHTHOUSES[1]}
    return SIGNER.sign(kind(**fields))


@given(signed())
def test_the_fields_are_those_that_a_signature_covers(message: SignedMessage) -> None:
    assert keccak256(covered(message)) == message_hash(message)
    assert reading(covered(message), type(message), generation_of(message)) is not None


@given(signed())
def test_no_signature_of_one_kind_is_accepted_as_another_kind(message: SignedMessage) -> None:
    factory = Factory(*LIGHTHOUSES)
    if not is_accepted(message, factory=factory):
        return
    for kind, generation in FIELDS:
        other = reading(covered(message), kind, generation)
        if other is None or (kind, generation) == (type(message), generation_of(message)):
            continue
        as_other = kind(
            **{field: getattr(other, field) for field in other.__struct_fields__} | {"signature": message.signature}
        )
        assert recover(message_hash(as_other), as_other.signature) == SIGNER.address, "the same bytes"
        assert not is_accepted(as_other, factory=factory), as_other


@pytest.mark.parametrize("generation", [3, 5])
@pytest.mark.parametrize(("kind", "other"), [(Offer, Demand), (Demand, Offer)])
def test_without_the_factory_s_knowledge_an_offer_is_a_demand(
    kind: type[Demand] | type[Offer], other: type[Demand] | type[Offer], generation: int
) -> None:
    """The danger is real: the test above could not fail otherwise."""
    more: dict[str, Any] = {"nonce": "ab" * 32} if generation == 3 else {"nonce": 1, "sender": SIGNER.address}
    more["validator_fee" if kind is Demand else "lighthouse_fee"] = 0
    order = SIGNER.sign(
        kind(
            model=cid_of_digest(b"\1" * 32),
            objective=cid_of_digest(b"\2" * 32),
            token=ACCOUNTS[1],
            cost=1,
            lighthouse=LIGHTHOUSES[0],
            validator=LIGHTHOUSES[1],
            deadline=10,
            **more,
        )
    )
    exchanged = reading(covered(order), other, generation)
    assert isinstance(exchanged, other)
    stolen = other(
        **{field: getattr(exchanged, field) for field in exchanged.__struct_fields__} | {"signature": order.signature}
    )
    assert (stolen.lighthouse, stolen.validator) == (LIGHTHOUSES[1], LIGHTHOUSES[0])
    assert is_accepted(order, factory=None)
    assert is_accepted(stolen, factory=None)
    assert not is_accepted(order, factory=Factory(*LIGHTHOUSES))
    assert not is_accepted(stolen, factory=Factory(*LIGHTHOUSES))


@given(signed(), addresses, hashes, st.text(max_size=200))
def test_a_cancellation_and_a_rejection_are_no_message(
    message: SignedMessage, address: str, order: str, detail: str
) -> None:
    rejection = Rejection(order=order, reason="expired", detail=detail, provider=SIGNER.address).signed_by(SIGNER)
    for signature in (SIGNER.sign_hash(cancellation_hash(address)).hex(), rejection.signature):
        if signature != message.signature:
            assert recover(message_hash(message), signature) != SIGNER.address
