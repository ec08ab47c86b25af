"""What an agent does on its market: it offers and demands jobs, follows their contracts, and exchanges files."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias, TypedDict, Unpack, overload

from mesh.agent.demands import current_buyer
from mesh.agent.errors import NotAnObjective, OrderClosed
from mesh.agent.orders import Order, OrderState
from mesh.agent.progress import nothing
from mesh.agent.validators import ValidatorSilent, check_named
from mesh.amounts import XRT
from mesh.errors import ClosedError, ConfigurationError
from mesh.recording import pack_values
from mesh.role import Lifecycle
from mesh.settings import load
from schemas import ZERO_ADDRESS, Demand, Offer, Result, Verified
from schemas.cid import is_cid

if TYPE_CHECKING:
    from mesh.agent.components import AgentComponents
    from mesh.agent.contract import Contract
    from mesh.agent.progress import OnProgress
    from mesh.agent.runtime import AgentRuntime
    from mesh.agent.terms import Terms
    from mesh.agent.validators import AnnouncedValidator
    from mesh.content import Store
    from mesh.network import Channel, Network
    from mesh.recording import Objective
    from mesh.settings import Settings

FETCH_PATIENCE: Final = 10.0
"""Seconds without a new block of an objective after which no offer is made for it."""


Messages: TypeAlias = Sequence[tuple[str, object]]
"""Topics with what is published on them: anything that `Job.publish` accepts."""


class DemandTerms(TypedDict, total=False):
    """The optional arguments of `Agent.order` and `Agent.demand`."""

    cost: int | str
    model: str
    token: str
    validator: str
    validator_fee: int | str | None
    lifetime: int | None


class TradingAgent(Lifecycle):
    """The trading methods of an `Agent`, and the parts of it that they use while it is open."""

    title = "agent"

    def __init__(self, model: str, settings: Settings | None) -> None:
        super().__init__()
        self.model = model
        self.settings = load() if settings is None else settings
        self._network: Network | None = None
        self._channel: Channel | None = None
        self._runtime: AgentRuntime | None = None

    @property
    def runtime(self) -> AgentRuntime:
        """The working side of a running agent. Raises `ClosedError` if it is not running or has no account."""
        self.channel  # raises when the agent is not running  # noqa: B018
        if self._runtime is None:
            raise ConfigurationError(
                "this agent has no account, it only watches",
                hint="give it one: keyfile and keyfile_password_file in the settings",
            )
        return self._runtime

    @property
    def parts(self) -> AgentComponents:
        """The components of a running agent. Raises as `runtime` does."""
        return self.runtime.parts

    @property
    def network(self) -> Network:
        """The Zenoh session and its state. Raises `ClosedError` if the agent is not running."""
        self.channel  # raises when the agent is not running  # noqa: B018
        assert self._network is not None
        return self._network

    @property
    def channel(self) -> Channel:
        """The lighthouse's channel. Raises `ClosedError` if the agent is not running."""
        if self._channel is None:
            raise ClosedError("the agent is not running", hint="use it inside `async with`")
        return self._channel

    @property
    def address(self) -> str:
        """The account's address (EIP-55)."""
        return self.parts.signer.address

    async def offer(
        self,
        demand: Verified[Demand] | Demand | None = None,
        *,
        objective: str = "",
        cost: int | str = 0,
        token: str = "",
        validator: str = "",
        lighthouse_fee: int | str = 0,
        lifetime: int | None = None,
    ) -> str:
        """Offer to do a job; returns the order's hash (hex). The offer is resent until it is matched or expires.

        With a `demand` the offer agrees to its terms, once its objective was examined; in generation 5, an open offer
        with the same fee for another version of it is enough. Else `objective` (CID), `cost` (`"5 XRT"`, or a number of
        the token's smallest unit), `token` and `validator` (names or addresses) are the terms, valid for `lifetime`
        blocks, by default about ten minutes. `lighthouse_fee` (`"0.1 XRT"`, or wn) is paid to the provider.

        Raises `InsufficientTokens`, `InvalidAmount`, for an objective that can't be played `ObjectiveUnfit` or a
        `ContentError`, and `Declined` for a demand whose validator wants a higher fee, or is not one of the setting
        `accepted_validators`.
        """
        trader, fee = self.runtime.trader, XRT.amount(lighthouse_fee)
        wanted = demand.message if isinstance(demand, Verified) else demand
        if wanted is not None:
            await self.runtime.validators.require_accepted(wanted, self.settings.accepted_validators)
            await self.examine(wanted.objective)
            if (answer := trader.answers.answer_to(wanted, lighthouse_fee=fee)) is not None:
                return answer.identity
            terms = trader.writer.terms_of(wanted)
        else:
            terms = await trader.writer.terms(
                model=self.model, objective=objective, cost=cost, token=token, validator=validator, lifetime=lifetime
            )
        return (await trader.post(Offer, terms, answers=wanted, lighthouse_fee=fee)).hash

    async def examine(self, cid: str) -> Objective:
        """The objective with that CID, fetched if needed, after it was checked as before a job.

        Raises `ObjectiveUnfit`, whose `reason` is a word for programs, and branches of `ContentError`; while a demand
        is handled also `ObjectiveNotFetched`, as what strangers make an agent fetch is limited.
        """
        return await self.runtime.objectives.examine(cid, patience=FETCH_PATIENCE, buyer=current_buyer())

    async def order(
        self,
        objective: str | Path | Messages,
        *,
        cost: int | str = 0,
        model: str = "",
        token: str = "",
        validator: str = "",
        validator_fee: int | str | None = None,
        lifetime: int | None = None,
    ) -> Order:
        """Demand a job; returns the open order, to be waited for or withdrawn: `await order.contract()`.

        `objective` is a CID, the path of a file (also as text), or messages that are played one after the other, such
        as `[("/blink", "red"), ("/stop", Empty())]`; the agent serves it. The other terms are as for `offer`;
        `validator_fee` is `"0.1 XRT"`, or wn; by default what the validator announces. The factory gets the allowance
        that they need. A restarted agent sends the order again.

        Raises `NotAnObjective`, `InvalidAmount`, `InsufficientTokens`, `ObjectiveUnfit` if a file is not playable, or
        if the model's description is available and excludes the objective, `UnsafeValidator` and its like for a
        validator that can't be named, and `ValidatorSilent` if its fee is not known because nobody answers.
        """
        writer = self.runtime.trader.writer
        cid = await self._cid_of(objective)
        terms = await writer.terms(
            model=model or self.model, objective=cid, cost=cost, token=token, validator=validator, lifetime=lifetime
        )
        await self.runtime.require_fit(cid, terms["model"])
        fee = await self._announced_fee(terms) if validator_fee is None else XRT.amount(validator_fee)
        return await self.runtime.trader.post(Demand, terms, validator_fee=fee)

    async def demand(
        self, objective: str | Path | Messages, *, on_progress: OnProgress = nothing, **terms: Unpack[DemandTerms]
    ) -> Contract:
        """Demand a job and wait for the contract: `contract = await agent.demand(…); await contract.outcome()`.

        The terms are those of `order`, `on_progress` that of `Order.contract`. Cancelling withdraws the demand. Raises
        `OrderExpired`, `OrderClosed` (withdrawn elsewhere) and `InsufficientTokens`.
        """
        order = await self.order(objective, **terms)
        try:
            return await order.contract(on_progress=on_progress)
        except asyncio.CancelledError:
            if self._runtime is not None:
                with suppress(OrderClosed):  # it has just become a contract
                    await order.withdraw()
            raise

    @overload
    async def validator(self, whose: str) -> AnnouncedValidator: ...

    @overload
    async def validator(self, whose: Verified[Demand] | Demand) -> AnnouncedValidator | None: ...

    async def validator(self, whose: str | Verified[Demand] | Demand) -> AnnouncedValidator | None:
        """How a validator (address or name), or that of a demand, judges, as its jurors announce it now.

        `AnnouncedValidator.is_silent` if none answers. None for a demand without a validator. The answers are kept for
        a minute. Raises `ChainError`, and for a name that can't be resolved what `demand` raises.
        """
        if not isinstance(whose, str):
            named = (whose.message if isinstance(whose, Verified) else whose).validator
            return None if named == ZERO_ADDRESS else await self.runtime.validators.find(named)
        return await self.runtime.validators.find(await self.parts.chain.names.address(whose))

    def orders(self, *states: OrderState) -> list[Order]:
        """The account's orders in these states, oldest first; by default the open ones, those of earlier runs included.

        Withdrawn ones are listed until their deadline. Matched and expired ones are not listed.
        """
        return self.runtime.trader.orders(*(states or (OrderState.OPEN,)))

    async def contract(self, address: str) -> Contract:
        """The contract at `address`, of any account; `outcome` waits for its end. Raises `NotALiability`."""
        return await self.runtime.trader.contracts.read(address)

    async def finish(self, address: str, *, success: bool) -> str:
        """End the job of the liability at `address` now; returns the recording's CID. Raises `WrongPhase`."""
        return await self.runtime.executor.finish(address, success=success)

    def send(self, message: Demand | Offer | Result) -> str:
        """Sign a message with the agent's account and put it on the market once; returns its key. It is not resent.

        Raises `UnsafeValidator` for an order with a validator that was not checked on the chain before, as `demand` and
        `offer` do.
        """
        if isinstance(message, Demand | Offer):
            self.parts.chain.validators.check_known(message)
        return self.channel.publish(self.parts.signer.sign(message))

    async def add(self, path: str | Path) -> str:
        """Copy a file to the agent's store, which serves it to others; returns its CID."""
        return await asyncio.to_thread(self.parts.store.put_file, Path(path))

    async def _announced_fee(self, terms: Terms) -> int:
        """What the validator of these terms wants, in wn. Raises `ValidatorSilent`."""
        if (validator := terms["validator"]) == ZERO_ADDRESS:
            return 0
        generation = self.settings.generation
        await check_named(self.parts.chain, validator, lighthouse=terms["lighthouse"], generation=generation)
        announced = await self.runtime.validators.find(validator)
        if announced.is_silent:
            raise ValidatorSilent(validator)
        return announced.fee

    async def _cid_of(self, objective: str | Path | Messages) -> str:
        """The CID of an objective, once the agent's store has it. Raises `NotAnObjective`, and `ObjectiveUnfit`."""
        if not isinstance(objective, str | Path):
            return await asyncio.to_thread(put_values, self.parts.store, objective)
        if isinstance(objective, str) and is_cid(objective):
            return objective
        if not await asyncio.to_thread(Path(objective).is_file):
            raise NotAnObjective(str(objective))
        await self.runtime.objectives.require_playable(Path(objective))
        return await self.add(objective)

    async def fetch(self, cid: str) -> Path:
        """The file with that CID, from the store or fetched from others and checked. Raises a `ContentError`."""
        limit, timeout = self.settings.objective_expanded_limit, self.settings.fetch_timeout
        return await self.parts.exchange.fetch(cid, size_limit=limit, timeout=timeout)


def put_values(store: Store, values: Messages, **options: Any) -> str:
    """Put a recording of values into a store; returns its CID. Blocks on the disk. `options` are of `pack_values`."""
    with tempfile.TemporaryDirectory(prefix="aira-values-") as folder:
        path = Path(folder) / "values.mcap"
        pack_values(values, path, **options)
        return store.put_file(path)
