"""What others may ask of an agent's account: to read for all, to spend and to sign where the settings say so."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent.agent import Agent
from mesh.chain import Account, Chain, new_private_key
from mesh.chain.errors import InsufficientFunds, Reverted, UnknownName
from mesh.testing._market import TIMING
from schemas import ZERO_ADDRESS, cid_of_bytes
from schemas.records import ControlRobot
from schemas.rpc import (
    GUARDED,
    AccountBalance,
    Accounts,
    AccountToAddressAllowance,
    Allowance,
    Approve,
    Balance,
    BlockNumber,
    FinishLiability,
    LiabilityRequest,
    SendResult,
    SignDemand,
    SignOffer,
    SignResult,
    TransferFromRequest,
    TransferRequest,
)
from tests.mesh.agent.conftest import Asker, asking, other_token
from tests.support.market import offering

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from schemas import Record
    from tests.support.market import Place

TERMS: dict[str, Any] = {
    "model": cid_of_bytes(b"model"),
    "objective": cid_of_bytes(b"objective"),
    "token": "xrt.3.robonomics.eth",
    "cost": 0,
    "lighthouse": "airalab.lighthouse.3.robonomics.eth",
    "validator": ZERO_ADDRESS,
    "deadline": 10**9,
}
RESULT: dict[str, Any] = {"liability": ZERO_ADDRESS, "result": cid_of_bytes(b"result"), "success": True}


@pytest.fixture
async def closed(place: Place) -> AsyncIterator[Asker]:
    """The robot, as it is when nothing is set."""
    async with asking(place, place.agent("robot")) as asker:
        yield asker


async def test_everyone_may_read_balances(place: Place, closed: Asker) -> None:
    robot, person, chain = place.address("robot"), place.address("person"), place.chains["person"]
    assert await closed.ask("eth/accounts") == Accounts((robot,))
    assert await closed.ask("eth/current_block") == BlockNumber(await chain.block_number())
    assert await closed.ask("eth/eth_balance") == Balance(await chain.tokens.eth_balance(robot))
    assert await closed.ask("eth/xrt_balance") == Balance(await chain.tokens.balance(robot))
    for account in (person, person.lower()):
        assert await closed.ask("eth/account_eth_balance", AccountBalance(account)) == Balance(
            await chain.tokens.eth_balance(person)
        )
        assert await closed.ask("eth/account_xrt_balance", AccountBalance(account)) == Balance(
            await chain.tokens.balance(person)
        )
    factory = AccountBalance("factory.3.robonomics.eth")
    assert (await closed.ask("eth/account_xrt_balance", factory)).balance == await chain.tokens.balance(chain.factory)


async def test_everyone_may_read_allowances(place: Place, closed: Asker) -> None:
    chain = place.chains["person"]
    await chain.tokens.approve(place.address("robot"), 123)
    asked = AccountToAddressAllowance(place.address("person"), place.address("robot"))
    assert await closed.ask("eth/account_xrt_allowance", asked) == Allowance(123)
    assert await closed.ask("eth/xrt_allowance") == Allowance(
        await chain.tokens.allowance(place.address("robot"), chain.factory)
    )


async def test_the_token_is_that_of_the_settings(place: Place) -> None:
    token, person = await other_token(place.chains["robot"], supply=1000), place.address("person")
    robot = place.agent("robot", erc20_token=token, open_services=True)
    async with asking(place, robot) as asker:
        assert await asker.ask("eth/xrt_balance") == Balance(1000)
        await asker.ask("eth/transfer", TransferRequest(person, 300))
        assert await asker.ask("eth/account_xrt_balance", AccountBalance(person)) == Balance(300)
        await asker.ask("eth/approve", Approve(place.chains["robot"].factory, 5))
        assert await asker.ask("eth/xrt_allowance") == Allowance(5)


REQUESTS: dict[str, Record] = {
    "control": ControlRobot(),
    "eth/transfer": TransferRequest(ZERO_ADDRESS, 1),
    "eth/transfer_from": TransferFromRequest(ZERO_ADDRESS, ZERO_ADDRESS, 1),
    "eth/approve": Approve(ZERO_ADDRESS, 1),
    "sign/demand": SignDemand(**TERMS, validator_fee=0),
    "sign/offer": SignOffer(**TERMS, lighthouse_fee=0),
    "sign/result": SignResult(**RESULT),
    "send/result": SendResult(**RESULT, signature="ab" * 65),
}


@pytest.mark.parametrize("service", sorted(REQUESTS))
async def test_the_services_of_the_owner_are_closed_by_default(closed: Asker, service: str) -> None:
    line = await closed.refused(service, REQUESTS[service])
    assert line.startswith(f"this agent does not offer {service} to others / set open_services")


def test_every_guarded_service_is_tested() -> None:
    assert GUARDED - REQUESTS.keys() == {"send/demand", "send/offer"}, "which are tested with the other messages"


async def test_tokens_are_sent_when_the_service_is_open(place: Place, opened: Asker) -> None:
    before = await place.balance("robot"), await place.balance("person")
    done = await opened.ask("eth/transfer", TransferRequest(place.address("person"), 250))
    assert (await place.balance("robot"), await place.balance("person")) == (before[0] - 250, before[1] + 250)
    receipt = await place.chains["person"].node.receipt(done.txhash)
    assert receipt is not None
    assert receipt.status == 1


async def test_concurrent_transfers_are_all_sent(place: Place, opened: Asker) -> None:
    before = await place.balance("person")
    request = TransferRequest(place.address("person"), 3)
    done = await asyncio.gather(*(opened.ask("eth/transfer", request) for _ in range(10)))
    assert len({one.txhash for one in done}) == 10
    assert await place.balance("person") == before + 30


async def test_tokens_that_were_approved_for_the_agent_are_sent(place: Place, opened: Asker) -> None:
    before = await place.balance("person"), await place.balance("provider")
    await place.chains["person"].tokens.approve(place.address("robot"), 40)
    request = TransferFromRequest(place.address("person"), place.address("provider"), 40)
    assert len((await opened.ask("eth/transfer_from", request)).txhash) == 66
    assert (await place.balance("person"), await place.balance("provider")) == (before[0] - 40, before[1] + 40)


async def test_an_allowance_is_given(place: Place, opened: Asker) -> None:
    await opened.ask("eth/approve", Approve(place.address("person"), 77))
    chain = place.chains["person"]
    assert await chain.tokens.allowance(place.address("robot"), place.address("person")) == 77


@pytest.mark.parametrize(
    ("request_", "said"),
    [
        (TransferRequest("the kitchen", 1), "'the kitchen' is not an address"),
        (TransferRequest("unknown.eth", 1), str(UnknownName("unknown.eth"))),
        (TransferRequest("kitchen.sink", 1), "'kitchen.sink' is not an ENS name"),
        (TransferRequest(ZERO_ADDRESS, 1), str(Reverted("ERC20InvalidReceiver"))),
        (TransferRequest("0x" + "12" * 20, 10**30), str(Reverted("ERC20InsufficientBalance"))),
    ],
)
async def test_a_refused_transaction_is_one_line(opened: Asker, request_: TransferRequest, said: str) -> None:
    assert (await opened.refused("eth/transfer", request_)).startswith(said)


async def test_the_error_of_an_account_without_ether_names_the_missing_amount(place: Place) -> None:
    poor = Account(new_private_key())
    chain = Chain(place.node.provider, account=poor, contracts=place.market.deployment.contracts, timing=TIMING)
    async with chain:
        agent = Agent(settings=place.settings("poor", open_services=True), account=poor, chain=chain)
        async with asking(place, agent) as asker:
            line = await asker.refused("eth/approve", Approve(place.address("person"), 0))
    assert line.startswith(f"{poor.address} has 0 ETH"), "the caller gets only the sentence"
    assert line.partition(" / ")[2] == InsufficientFunds(poor.address, balance=0, needed=1).hint


async def test_a_chain_that_was_opened_for_reading_sends_nothing(place: Place) -> None:
    reader = Chain(place.node.provider, contracts=place.market.deployment.contracts, timing=TIMING)
    async with reader:
        settings = place.settings("robot", open_services=True)
        agent = Agent(settings=settings, account=place.market.accounts["robot"], chain=reader)
        async with asking(place, agent) as asker:
            line = await asker.refused("eth/approve", Approve(place.address("person"), 0))
    assert line.startswith("this needs an account")


async def test_services_that_drive_jobs_are_closed_by_default_for_handlers(place: Place) -> None:
    """Its handlers start and end its jobs; without handlers, only a program that drives it can."""
    robot = offering(place.agent("robot"))

    @robot.on("/say")
    async def say(job: Any, word: Any) -> None:
        raise AssertionError

    async with asking(place, robot) as asker:
        requests = {"start": LiabilityRequest(ZERO_ADDRESS), "finish": FinishLiability(ZERO_ADDRESS, False)}
        for service, request in requests.items():
            refused = await asker.refused(service, request)
            assert refused.startswith(f"this agent does not offer {service} to others")
        assert not (await asker.ask("read", LiabilityRequest(ZERO_ADDRESS))).read
    robot = place.agent("robot", open_services=True)
    robot.on("/say")(say)
    async with asking(place, robot) as asker:
        assert not (await asker.ask("start", LiabilityRequest(ZERO_ADDRESS))).success
