"""Messages about which a validator has to ask the chain: their ENS names, and the validators of orders."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING

import pytest
import zenoh
from msgspec.structs import replace

from mesh.base.flood import Drops
from mesh.chain import UnknownName
from mesh.errors import AiraError, RemoteError
from mesh.network import Channel, MarketRules, message_key
from mesh.network._validation import RESOLVER_LIMITS, NameCache, Unresolved
from schemas import Demand, Offer, Verified, encode, message_hash
from tests.support.clocks import SECOND, SetClock
from tests.support.network.validating import NAME, check, check_payload, counted, validator
from tests.support.orders import MARKET, PERSON, ROBOT, STRANGER, demand, offer
from tests.support.waiting import until, until_heard

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable


def resolving(addresses: dict[str, str]) -> Callable[[str], Awaitable[str]]:
    async def resolve(name: str) -> str:
        if name not in addresses:
            raise UnknownName(name)
        return addresses[name]

    return resolve


class Known:
    """Verdicts on validators, which are known once they were asked for."""

    def __init__(self, **verdicts: bool) -> None:
        self._verdicts = verdicts
        self.asked: list[str] = []

    def known(self, validator: str) -> bool | None:
        return self._verdicts.get(validator) if validator in self.asked else None

    async def is_safe(self, validator: str) -> bool:
        self.asked.append(validator)
        if validator not in self._verdicts:
            raise RemoteError("the node is lost")
        return self._verdicts[validator]


async def test_a_message_with_a_name_is_accepted_once_the_name_is_resolved() -> None:
    checked, message = validator(resolver=resolving({NAME: STRANGER.address})), demand(token=STRANGER.address)
    named = json.loads(encode(message)) | {"token": NAME.upper()}
    key = message_key(MARKET, message)

    waiting = check_payload(checked, key, json.dumps(named).encode())

    assert isinstance(waiting, Unresolved)
    assert waiting.message.token == NAME
    assert await checked.complete(waiting) == Verified(message, message_hash(message), PERSON.address)
    assert check_payload(checked, key, json.dumps(named).encode()) is None, "a duplicate is not resolved again"
    assert await checked.complete(waiting) is None, "it was accepted meanwhile"
    assert checked.statistics(received=0, dropped=0).duplicate == 2


async def test_a_message_with_an_unknown_name_is_counted() -> None:
    checked, message = validator(resolver=resolving({})), demand(token=STRANGER.address)
    named = json.loads(encode(message)) | {"token": NAME}
    waiting = check_payload(checked, message_key(MARKET, message), json.dumps(named).encode())
    assert isinstance(waiting, Unresolved)

    assert await checked.complete(waiting) is None
    assert counted(checked) == {"name": 1}


async def test_a_message_whose_name_resolves_to_another_address_is_not_its_signers() -> None:
    checked, message = validator(resolver=resolving({NAME: ROBOT.address})), demand(token=STRANGER.address)
    named = json.loads(encode(message)) | {"token": NAME}
    waiting = check_payload(checked, message_key(MARKET, message), json.dumps(named).encode())
    assert isinstance(waiting, Unresolved)

    verified = await checked.complete(waiting)

    assert not isinstance(verified, Verified) or verified.signer != PERSON.address


async def test_a_forgotten_message_with_a_name_is_accepted_once_more() -> None:
    checked, message = validator(resolver=resolving({NAME: STRANGER.address})), demand(token=STRANGER.address)
    named = json.dumps(json.loads(encode(message)) | {"token": NAME}).encode()
    waiting = check_payload(checked, message_key(MARKET, message), named)
    assert isinstance(waiting, Unresolved)
    verified = await checked.complete(waiting)
    assert isinstance(verified, Verified)

    checked.forget(verified)

    assert check_payload(checked, message_key(MARKET, message), named) == verified, "its name is known"


async def test_an_order_is_accepted_once_its_validator_is_known_to_be_safe() -> None:
    known = Known(**{STRANGER.address: True})
    checked, message = validator(validators=known), demand(validator=STRANGER.address)
    key = message_key(MARKET, message)

    waiting = check_payload(checked, key, encode(message))
    assert isinstance(waiting, Unresolved)
    assert await checked.complete(waiting) == Verified(message, message_hash(message), PERSON.address)
    assert check(checked, message) is None, "a duplicate"
    assert check(checked, demand(validator=STRANGER.address)) is not None
    assert known.asked == [STRANGER.address], "once for each validator"


async def test_an_order_whose_validator_is_a_lighthouse_is_counted() -> None:
    known = Known(**{STRANGER.address: False})
    checked = validator(Offer, validators=known)
    message = offer(validator=STRANGER.address)
    waiting = check_payload(checked, message_key(MARKET, message), encode(message))
    assert isinstance(waiting, Unresolved)

    assert await checked.complete(waiting) is None
    assert check(checked, offer(validator=STRANGER.address)) is None, "known now"
    assert (counted(checked), known.asked) == ({"validator": 2}, [STRANGER.address])


async def test_an_order_whose_validator_can_t_be_checked_is_counted_and_may_come_again() -> None:
    known = Known()
    checked, message = validator(validators=known), demand(validator=STRANGER.address)
    for _ in range(2):
        waiting = check_payload(checked, message_key(MARKET, message), encode(message))
        assert isinstance(waiting, Unresolved)
        assert await checked.complete(waiting) is None
    assert counted(checked) == {"validator": 2}


def test_the_chain_is_asked_about_no_order_without_a_validator_or_with_a_wrong_signature() -> None:
    checked = validator(validators=Known())
    forged = replace(demand(validator=STRANGER.address), signature="ff" * 65)

    assert check(checked, demand()) is not None
    assert check(checked, forged) is None
    assert counted(checked) == {"signature": 1}


async def test_a_name_is_asked_about_once_a_minute_and_after_a_failure_once_in_ten_seconds() -> None:
    clock, asked = SetClock(), list[str]()

    async def resolve(name: str) -> str:
        asked.append(name)
        if name != NAME:
            raise UnknownName(name)
        return STRANGER.address

    names = NameCache(resolve, clock=clock)
    assert names.known([NAME]) is None
    for _ in range(3):
        assert await names.addresses([NAME]) == {NAME: STRANGER.address}
        assert names.known([NAME]) == {NAME: STRANGER.address}
        with pytest.raises(AiraError):
            await names.addresses(["unknown.eth"])
    assert asked == [NAME, "unknown.eth"]

    clock.pass_by(round(RESOLVER_LIMITS.failure_kept * SECOND))
    assert names.known(["unknown.eth"]) is None
    assert names.known([NAME]) is not None
    clock.pass_by(round(RESOLVER_LIMITS.kept * SECOND))
    assert names.known([NAME]) is None


async def test_unknown_names_take_little_of_the_chain_and_no_lookups_of_known_signers(
    here: zenoh.Session, there: zenoh.Session
) -> None:
    asked, drops, known = list[str](), Drops(), Known(**{STRANGER.address: True})

    async def resolve(name: str) -> str:
        asked.append(name)
        raise UnknownName(name)

    async with (
        Channel(here, MarketRules(MARKET, resolver=resolve, validators=known), drops=drops) as ours,
        ours.subscribe(Demand) as demands,
    ):
        await until_heard(there, message_key(MARKET, demand()))
        for number in range(1000):
            put(there, replace(demand(), validator=f"nobody-{number}.eth"))
        put(there, order := demand(validator=STRANGER.address))

        async with asyncio.timeout(60):
            assert (await anext(demands)).message == order
        await until(lambda: demands.statistics().received == 1001)
        assert 1 <= len(asked) < 200
        assert drops.totals()["lookup"] > 500


def put(session: zenoh.Session, message: Demand) -> None:
    block = zenoh.CongestionControl.BLOCK
    session.put(message_key(MARKET, message), encode(message), congestion_control=block)
