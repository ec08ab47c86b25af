"""A provider and validated liabilities: it gathers the jurors' results until a quorum agrees, and finalizes by them."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest
from msgspec import structs

from mesh.chain import Account, DeploymentPlan, TransactionSender, new_private_key
from mesh.market import _settlement
from mesh.market._orders import OrderLimits
from mesh.testing import MarketChain
from mesh.testing._market import working_provider
from schemas import address_bytes, cid_of_bytes
from tests.support.contracts.suite import artifact
from tests.support.orders import RECORDING
from tests.support.provider.local_market import LocalMarket
from tests.support.provider.observation import events, until_read
from tests.support.waiting import until, until_found, until_heard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator, Sequence

    from mesh.market.provider import Provider
    from schemas import Liability, Result
    from tests.support.routers import EmbeddedRouter

REFUND_DELAY = 12
COST = 5
LAST_BLOCK = 1_000_000
FEE = 7
OTHER_RECORDING = cid_of_bytes(b"another recording")
FLOOD = 1_500
SETTLING = 0.3
"""Seconds in which a wrong finalization would have been sent."""


@pytest.fixture(scope="module")
def courthouse() -> Iterator[MarketChain]:
    """A market on a chain of its own, where a refund is soon possible."""
    with asyncio.Runner() as runner:
        stack = AsyncExitStack()
        plan = DeploymentPlan(refund_delay=REFUND_DELAY, timeout_blocks=100)
        try:
            yield runner.run(stack.enter_async_context(MarketChain(plan)))
        finally:
            runner.run(stack.aclose())


class Court:
    """A local market whose person can pay, with juries."""

    def __init__(self, local: LocalMarket) -> None:
        self.local = local

    async def jury(self, *, quorum: int, size: int) -> tuple[str, list[Account]]:
        """A jury of new accounts, in ascending order; the rival keeps it."""
        jurors = [Account(new_private_key()) for _ in range(size)]
        jurors.sort(key=lambda juror: address_bytes(juror.address))
        async with self.local.chain_of("rival") as chain:
            deployed = await chain.validators.deploy([juror.address for juror in jurors], quorum)
        return deployed.address, jurors

    async def job(self, provider: Provider, validator: str, *, generation: int = 5) -> Liability:
        """A liability that the provider has created, with that validator."""
        demand_author: dict[str, Any] = {}
        offer_author: dict[str, Any] = {}
        if generation == 5:
            demand_author, offer_author = await self._author("person"), await self._author("robot")
            offer_author["deadline"] = demand_author["deadline"] = LAST_BLOCK - provider.earnings().created
        demand = self.local.demand(cost=COST, validator=validator, validator_fee=FEE, **demand_author)
        before = provider.earnings().created
        self.local.publish(demand, self.local.offer(cost=COST, validator=validator, **offer_author))
        liability = await self.local.liability_of(demand)
        await until(lambda: provider.earnings().created == before + 1)
        await until_read(self.local, provider)
        return liability

    def verdict(self, liability: Liability, juror: Account, **changes: Any) -> Result:
        """A juror's signed result."""
        result = self.local.result(liability.address, **changes)
        return juror.signer.sign(structs.replace(result, signature=""))

    async def ended(self, liability: Liability) -> Liability:
        """Wait until a liability is finalized."""
        found: list[Liability] = []

        async def is_finalized() -> bool:
            found.append(await self.read(liability))
            return found[-1].is_finalized

        await until_found(is_finalized, what="the end")
        return found[-1]

    async def stays_open(self, provider: Provider, liability: Liability) -> None:
        """Check that the liability is not finalized, nor a transaction wasted, after all was received."""
        await asyncio.sleep(SETTLING)
        assert not (await self.read(liability)).is_finalized
        assert provider.earnings().finalized == 0

    async def read(self, liability: Liability) -> Liability:
        return await self.local.chain.liabilities.get(liability.address)

    async def balance(self, role: str) -> int:
        return await self.local.chain.tokens.balance(self.local.address(role))

    async def _author(self, role: str) -> dict[str, Any]:
        address = self.local.address(role)
        return {"sender": address, "nonce": await self.local.chain.liabilities.next_nonce(address)}


@pytest.fixture
async def court(courthouse: MarketChain, router: EmbeddedRouter) -> AsyncIterator[Court]:
    node = courthouse.node
    async with LocalMarket(courthouse.market, router.endpoint, node=node.provider, keys=node.funded_keys) as local:
        async with local.chain_of("person") as chain:
            await chain.tokens.approve(courthouse.market.deployment.factory, 10_000)
        yield Court(local)


@pytest.fixture
async def provider(court: Court) -> AsyncIterator[Provider]:
    async with court.local.provider() as provider:
        yield provider


@asynccontextmanager
async def paid(court: Court, *, success: bool = True) -> AsyncIterator[None]:
    """Check that a job ends meanwhile, and who is paid for it."""
    roles = ("person", "robot")
    before = [await court.balance(role) for role in roles]
    yield
    after = [await court.balance(role) for role in roles]
    changes = [now - then for now, then in zip(after, before, strict=True)]
    assert changes == ([0, COST] if success else [COST, 0])


@pytest.mark.parametrize("success", [True, False])
async def test_one_juror_decides_and_the_promisors_own_result_is_no_error(
    court: Court, provider: Provider, success: bool
) -> None:
    validator, (juror,) = await court.jury(quorum=1, size=1)
    liability = await court.job(provider, validator)
    own = court.local.result(liability.address)
    court.local.publish(own)
    await court.stays_open(provider, liability)
    async with paid(court, success=success):
        court.local.publish(court.verdict(liability, juror, success=success))
        assert (await court.ended(liability)).is_success == success
    assert (await court.read(liability)).result == RECORDING
    jury = await court.local.chain.validators.jury(validator)
    assert jury is not None
    assert jury.fees == FEE
    assert court.local.rejections == []


async def test_two_of_three_jurors_finalize_in_any_order_and_a_late_one_changes_nothing(
    court: Court, provider: Provider
) -> None:
    validator, jurors = await court.jury(quorum=2, size=3)
    for first, second, late in (jurors, jurors[::-1]):
        liability = await court.job(provider, validator)
        court.local.publish(court.verdict(liability, first))
        await until(lambda: len(provider.orders.held(liability.address)) == 1)  # noqa: B023
        assert not (await court.read(liability)).is_finalized
        court.local.publish(court.verdict(liability, second))
        assert (await court.ended(liability)).is_success
        court.local.publish(court.verdict(liability, late))
    await until(lambda: provider.earnings().finalized == 2)
    assert court.local.rejections == []
    assert provider.earnings().rejected == {}


async def test_jurors_who_disagree_leave_the_refund(court: Court, provider: Provider) -> None:
    validator, (first, second) = await court.jury(quorum=2, size=2)
    liability = await court.job(provider, validator)
    before = await court.balance("person")
    court.local.publish(court.verdict(liability, first), court.verdict(liability, second, success=False))
    await until(lambda: len(provider.orders.held(liability.address)) == 2)
    await court.stays_open(provider, liability)
    await court.local.mine(REFUND_DELAY)
    async with court.local.chain_of("person") as chain:
        await chain.liabilities.refund(liability.address)
    assert not (await court.read(liability)).is_success
    assert await court.balance("person") == before + COST + FEE


async def test_a_juror_who_disagrees_is_outvoted(court: Court, provider: Provider) -> None:
    validator, (first, second, third) = await court.jury(quorum=2, size=3)
    liability = await court.job(provider, validator)
    court.local.publish(court.verdict(liability, first))
    await until(lambda: provider.orders.held(liability.address))
    async with paid(court, success=False):
        court.local.publish(*(court.verdict(liability, juror, success=False) for juror in (second, third)))
        assert not (await court.ended(liability)).is_success


async def test_a_juror_that_signs_nonsense_does_not_count_and_prevents_nothing(
    court: Court, provider: Provider
) -> None:
    validator, (first, second, liar) = await court.jury(quorum=2, size=3)
    other_validator, (stranger,) = await court.jury(quorum=1, size=1)
    liability = await court.job(provider, validator)
    other = await court.job(provider, other_validator)
    sound = court.verdict(liability, first)
    spoiled = structs.replace(sound, signature="11" * 64 + "1b")
    court.local.publish(
        court.verdict(other, liar),
        court.verdict(liability, liar, result=OTHER_RECORDING),
        court.verdict(liability, stranger),
        court.verdict(liability, liar, success=False),
        sound,
        structs.replace(court.verdict(liability, second), signature=sound.signature),
        spoiled,
    )
    await until(lambda: len(provider.orders.held(liability.address)) == 2)
    await court.stays_open(provider, liability)
    assert not (await court.read(other)).is_finalized
    court.local.publish(court.verdict(liability, second))
    ended = await court.ended(liability)
    assert (ended.is_success, ended.result) == (True, RECORDING)
    assert provider.drops.totals()["no-juror"] >= 2
    assert court.local.rejections == []


async def test_a_jurors_last_result_counts(court: Court, provider: Provider) -> None:
    validator, (first, second) = await court.jury(quorum=2, size=2)
    liability = await court.job(provider, validator)
    unconfirmed = provider.orders
    for changes in ({"success": False}, {"result": OTHER_RECORDING}, {}):
        court.local.publish(verdict := court.verdict(liability, first, **changes))
        await until(lambda: [one.message for one in unconfirmed.held(liability.address)] == [verdict])
    court.local.publish(court.verdict(liability, second))
    assert (await court.ended(liability)).is_success


async def test_jurors_who_race_with_the_same_verdict_cost_one_transaction(court: Court, provider: Provider) -> None:
    validator, jurors = await court.jury(quorum=1, size=2)
    liability = await court.job(provider, validator)
    calls = Calls(provider)
    async with paid(court):
        court.local.publish(*(court.verdict(liability, juror) for juror in jurors))
        await court.ended(liability)
        await until(lambda: provider.earnings().finalized == 1)
    court.local.publish(*(court.verdict(liability, juror) for juror in jurors))
    await asyncio.sleep(SETTLING)
    assert calls.made("eth_estimateGas") == 1
    assert provider.earnings().finalized == 1
    assert provider.earnings().rejected == {}
    assert court.local.rejections == []


async def test_a_provider_that_restarts_hears_the_jurors_again(court: Court) -> None:
    validator, (first, second) = await court.jury(quorum=2, size=2)
    async with court.local.provider() as before:
        liability = await court.job(before, validator)
        court.local.publish(verdict := court.verdict(liability, first))
        await until(lambda: before.orders.held(liability.address))
    async with court.local.provider() as after:
        await until_read(court.local, after)
        court.local.publish(court.verdict(liability, second))
        await court.stays_open(after, liability)
        court.local.publish(verdict)
        assert (await court.ended(liability)).is_success


async def test_jurors_are_heard_again_after_a_node_did_not_know_their_jury(
    court: Court, provider: Provider, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of several nodes may be behind, or wrong, for a while."""
    validator, (juror,) = await court.jury(quorum=1, size=1)
    liability = await court.job(provider, validator)
    monkeypatch.setattr(_settlement, "VALIDATOR_LIMITS", _settlement.VALIDATOR_LIMITS._replace(believed=0.1))
    validators, asked = provider._chain.validators, list[str]()

    async def unknown(validator: str) -> int:
        asked.append(validator)
        return 0

    with monkeypatch.context() as wrong:
        wrong.setattr(validators, "quorum", unknown)
        court.local.publish(verdict := court.verdict(liability, juror))
        await until(lambda: asked)
    async with asyncio.timeout(30):
        while not (await court.read(liability)).is_finalized:
            court.local.publish(verdict)
            await asyncio.sleep(0.05)


async def test_a_reverted_finalization_is_sent_again(court: Court, provider: Provider) -> None:
    validator, jurors = await court.jury(quorum=2, size=3)
    liability = await court.job(provider, validator)
    head = await court.local.chain.block_number()
    court.local.publish(*(court.verdict(liability, juror) for juror in jurors[:2]))
    await court.ended(liability)
    await until_read(court.local, provider)
    await court.local.request("evm_revert", hex(head))
    assert not (await court.read(liability)).is_finalized
    await court.local.mine(3)
    assert (await court.ended(liability)).is_success


async def test_a_flood_of_strangers_costs_the_node_nothing(court: Court, provider: Provider) -> None:
    validator, jurors = await court.jury(quorum=2, size=3)
    liability = await court.job(provider, validator)
    court.local.publish(court.verdict(liability, jurors[0]))
    await until(lambda: provider.orders.held(liability.address))
    calls = Calls(provider)
    strangers = [Account(new_private_key()) for _ in range(FLOOD)]
    court.local.publish(*(court.verdict(liability, stranger) for stranger in strangers))
    await until(lambda: provider.drops.totals().get("no-juror", 0) == FLOOD)
    assert calls.made("eth_call", "eth_getCode") == 0
    court.local.publish(court.verdict(liability, jurors[1]))
    assert (await court.ended(liability)).is_success
    assert court.local.rejections == []


async def test_another_validator_accepts_one_signature_and_is_not_asked_about_every_stranger(
    court: Court, provider: Provider
) -> None:
    signer = Account(new_private_key())
    argument = address_bytes(signer.address).rjust(32, b"\0")
    validator = await deployed(court, "OneSigner", argument)
    liability = await court.job(provider, validator)
    calls = Calls(provider)
    budget = int(_settlement.VALIDATOR_LIMITS.questions.burst)
    strangers = [Account(new_private_key()) for _ in range(4 * budget)]
    court.local.publish(*(court.verdict(liability, stranger) for stranger in strangers))
    await until(lambda: provider.drops.totals().get("no-juror", 0) == len(strangers))
    assert calls.made("eth_call") < 2 * budget
    other = await court.job(provider, await deployed(court, "OneSigner", argument))
    court.local.publish(court.verdict(other, signer, success=False))
    assert not (await court.ended(other)).is_success
    assert court.local.rejections == []


async def test_a_validator_that_fails_only_in_blocks_is_soon_left_alone(
    court: Court, provider: Provider, caplog: pytest.LogCaptureFixture
) -> None:
    """It accepts everybody in a simulation, where gas is free; in a block it reverts."""
    code = bytes.fromhex("3a156008575f5ffd5b60015f5260205ff3")
    validator = await placed(court, bytes.fromhex(f"60{len(code):02x}8060095f395ff3") + code)
    liability = await court.job(provider, validator)
    calls, burst = Calls(provider), int(_settlement.VALIDATOR_LIMITS.wasted.burst)
    strangers = [Account(new_private_key()) for _ in range(4 * burst)]
    court.local.publish(*(court.verdict(liability, stranger) for stranger in strangers))
    await until(lambda: events(caplog, "validator-shunned"))
    await court.stays_open(provider, liability)
    assert calls.made("eth_sendRawTransaction") == burst + 1
    validator, (juror,) = await court.jury(quorum=1, size=1)
    other = await court.job(provider, validator)
    court.local.publish(court.verdict(other, juror))
    assert (await court.ended(other)).is_success


async def test_the_originals_can_not_be_finalized_by_several(court: Court) -> None:
    """They take one signature, so a jury's quorum must be 1 there."""
    session = await court.local.new_session()
    async with (
        court.local.chain_of("provider", kind="original", generation=5) as chain,
        working_provider(session, chain, court.local.market) as provider,
    ):
        for keys in ("demand/x", "offer/x", "result"):
            await until_heard(court.local.session, f"aira/{court.local.market}/{keys}")
        for quorum in (2, 1):
            validator, jurors = await court.jury(quorum=quorum, size=2)
            liability = await court.job(provider, validator)
            court.local.publish(*(court.verdict(liability, juror) for juror in jurors))
            if quorum == 1:
                assert (await court.ended(liability)).is_success
            else:
                await until(lambda: provider.earnings().rejected == {"NotOffered": 2})
                await court.stays_open(provider, liability)


@pytest.mark.parametrize("kind", ["account", "contract"])
async def test_in_generation_3_results_wait_for_the_validator_itself(
    court: Court, provider: Provider, kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    judge = court.local.accounts["rival"]
    validator = judge.address if kind == "account" else (await court.jury(quorum=1, size=1))[0]
    liability = await court.job(provider, validator, generation=3)
    court.local.publish(own := court.local.result(liability.address), court.verdict(liability, judge))
    await court.stays_open(provider, liability)
    assert court.local.rejections == []
    assert events(caplog, "message-rejected") == []
    if kind == "account":
        async with paid(court), court.local.chain_of("rival") as chain:
            await chain.liabilities.validate(own, agree=True)


async def test_in_generation_3_a_jurors_result_is_tried_once(court: Court, provider: Provider) -> None:
    validator, (juror,) = await court.jury(quorum=1, size=1)
    liability = await court.job(provider, validator, generation=3)
    calls = Calls(provider)
    for _ in range(3):
        court.local.publish(court.verdict(liability, juror))
        await until(lambda: calls.made("eth_estimateGas") == 1)
        await court.stays_open(provider, liability)
    assert calls.made("eth_estimateGas") == 1
    assert court.local.rejections == []


async def test_what_does_not_fit_is_heard_again(court: Court, monkeypatch: pytest.MonkeyPatch) -> None:
    validator, (first, second) = await court.jury(quorum=2, size=2)
    async with court.local.provider() as provider:
        monkeypatch.setattr(provider.orders, "_limits", OrderLimits(held=2))
        jobs = [await court.job(provider, validator) for _ in range(4)]
        verdicts = [court.verdict(job, first) for job in jobs]
        court.local.publish(*verdicts)
        await until(lambda: provider.drops.totals().get("judgements-full") == 2)
        held = [bool(provider.orders.held(job.address)) for job in jobs]
        assert held == [False, False, True, True]
        court.local.publish(court.verdict(jobs[0], second), verdicts[0])
        assert (await court.ended(jobs[0])).is_success


async def deployed(court: Court, name: str, arguments: bytes) -> str:
    """A contract that only tests use."""
    return await placed(court, bytes.fromhex(artifact(name)["bytecode"][2:]) + arguments)


async def placed(court: Court, creation: bytes) -> str:
    """The contract that some code creates."""
    async with court.local.chain_of("rival") as chain:
        receipt = await TransactionSender(chain.node, court.local.accounts["rival"]).send(to=None, data=creation)
    assert receipt.contract is not None
    return receipt.contract


class Calls:
    """What a provider asks its node from now on."""

    def __init__(self, provider: Provider) -> None:
        self._asked: list[str] = []
        rpc = provider._chain.node.rpc
        request = rpc.request

        async def counted(method: str, params: Sequence[Any], **options: Any) -> Any:
            self._asked.append(method)
            return await request(method, params, **options)

        rpc.request = counted  # type: ignore[method-assign]

    def made(self, *methods: str) -> int:
        """How many requests there were of these methods."""
        return sum(self._asked.count(method) for method in methods)
