"""A market for one test: a router, a lighthouse, and accounts of traders and providers."""

from __future__ import annotations

from contextlib import AsyncExitStack, asynccontextmanager
from itertools import count
from typing import TYPE_CHECKING, Any, Self

from mesh.base.retry import RetryPolicy
from mesh.chain import XRT, Account, Chain, Timing
from mesh.chain.following import NewLiability
from mesh.network import Channel, Endpoints, Network
from mesh.testing._market import working_provider
from schemas import Demand, Offer, RejectKey, Result, market_selector, message_hash, parse_key, verify_message
from schemas.signing import Rejection
from tests.support.market import contracts_in
from tests.support.orders import RECORDING, terms, withdrawal
from tests.support.waiting import until, until_found, until_heard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Sequence

    import zenoh

    from mesh.chain.rpc import Transport
    from mesh.dev.development import DevelopmentMarket
    from mesh.market import Match
    from mesh.market.provider import Provider
    from schemas import Liability, SignedMessage, Withdrawal

QUICK = Timing(poll_interval=0.02, receipt_interval=0.01, attempts=1, retry_delay=0.01)
QUICK_RETRY = RetryPolicy(initial=0.01, ceiling=0.1, attempts=8)
STAKE = XRT

_names = count(1)


class LocalMarket:
    """`async with LocalMarket(market, endpoint, node=…, keys=…) as local`, at a router and a chain node.

    The person and the robot of the market trade; `rival` and `poor` are further accounts, which have ETH and no XRT.
    """

    def __init__(
        self, market: DevelopmentMarket, endpoint: str, *, node: str | Transport, keys: Sequence[bytes]
    ) -> None:
        self.node = node
        self.deployment = market.deployment
        self.accounts = market.accounts | {
            "rival": Account(keys[5]),
            "poor": Account(keys[6]),
        }
        self.endpoint = endpoint
        self.lighthouse = self.deployment.lighthouse
        self.market = self.deployment.lighthouse_name
        self.rejections: list[Rejection] = []
        self.rejected_makers: dict[str, str] = {}
        """The account to which the last rejection of each message was addressed."""
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> Self:
        self.chain = await self._stack.enter_async_context(self.chain_of("person"))
        self.started = await self.chain.block_number()
        self.session = await self.new_session()
        await self.trade_at(self.lighthouse, self.market)
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self._stack.aclose()

    async def new_session(self) -> zenoh.Session:
        """A new session with the router."""
        network = await self._stack.enter_async_context(Network(Endpoints(connect=(self.endpoint,))))
        return network.session

    async def trade_at(self, lighthouse: str, market: str) -> None:
        """Publish messages and receive rejections at this lighthouse (address and name) from now on."""
        self.lighthouse, self.market = lighthouse, market
        self.channel = await self._stack.enter_async_context(Channel(self.session, market))
        selector = market_selector(market, "reject")
        self._stack.enter_context(self.session.declare_subscriber(selector, self._rejected))

    async def create_lighthouse(self, *, timeout_blocks: int, **stakes: int) -> None:
        """Create a lighthouse where the named accounts have these quotas, and trade there."""
        async with self.chain_of("provider") as chain:
            made = await chain.lighthouses.create(
                minimal_stake=STAKE,
                timeout_blocks=timeout_blocks,
                name=f"local-{next(_names)}",
            )
            for role, turns in stakes.items():
                await chain.tokens.transfer(self.address(role), turns * STAKE)
        for role, turns in stakes.items():
            await self.stake(role, made.lighthouse, turns)
        await self.trade_at(made.lighthouse, f"{made.name}.lighthouse.3.robonomics.eth")

    async def stake(self, role: str, lighthouse: str, turns: int) -> None:
        """Stake for a quota of `turns` transactions; the account must have the XRT."""
        async with self.chain_of(role) as chain:
            await chain.tokens.approve(lighthouse, turns * STAKE)
            await chain.lighthouses.refill(lighthouse, turns * STAKE)

    def address(self, role: str) -> str:
        """An account's address."""
        return self.accounts[role].address

    def chain_of(self, role: str, endpoint: str | Transport | None = None, **options: Any) -> Chain:
        """The chain for an account, not yet open."""
        return Chain(
            endpoint or self.node,
            account=self.accounts[role],
            contracts=contracts_in(options, ens=self.deployment.ens),
            **({"timing": QUICK} | options),
        )

    async def request(self, method: str, *params: Any) -> Any:
        """The node's answer to a JSON-RPC method."""
        return await self.chain.node.request(method, *params)

    async def mine(self, blocks: int) -> None:
        """Mine empty blocks."""
        await self.request("evm_mine", blocks)

    @asynccontextmanager
    async def provider(
        self,
        role: str = "provider",
        *,
        endpoint: str | Transport | None = None,
        timing: Timing = QUICK,
        matched: Callable[[Match], None] = lambda match: None,
        **options: Any,
    ) -> AsyncIterator[Provider]:
        """A running provider that the traders can reach."""
        session = await self.new_session()
        async with (
            self.chain_of(role, endpoint, timing=timing) as chain,
            working_provider(
                session, chain, self.market, matched=matched, **({"retry": QUICK_RETRY} | options)
            ) as provider,
        ):
            for keys in ("demand/x", "offer/x", "result"):
                await until_heard(self.session, f"aira/{self.market}/{keys}")
            yield provider

    def demand(self, role: str = "person", **changes: Any) -> Demand:
        """A signed demand at this lighthouse, with the cost 0 by default."""
        return self.accounts[role].signer.sign(Demand(**({"validator_fee": 0} | self._terms(changes))))

    def offer(self, role: str = "robot", **changes: Any) -> Offer:
        """A signed offer that matches a demand with the same changes."""
        return self.accounts[role].signer.sign(Offer(**({"lighthouse_fee": 0} | self._terms(changes))))

    def withdrawal(self, order: Demand | Offer, role: str = "person") -> Withdrawal:
        """The withdrawal of an order, signed by a trader."""
        return withdrawal(order, signer=self.accounts[role].signer)

    def result(self, liability: str, role: str = "robot", **changes: Any) -> Result:
        """A signed result."""
        fields: dict[str, Any] = {"liability": liability, "result": RECORDING, "success": True}
        return self.accounts[role].signer.sign(Result(**(fields | changes)))

    def publish(self, *messages: SignedMessage) -> None:
        """Publish messages."""
        for message in messages:
            self.channel.publish(message)

    async def liability_of(self, order: Demand | Offer) -> Liability:
        """Wait for the liability that is created from an order."""
        found: list[Liability] = []

        async def search() -> bool:
            found.extend(await self.liabilities_of(order))
            return bool(found)

        await until_found(search, what="the contract")
        return found[0]

    async def liabilities_of(self, order: Demand | Offer) -> list[Liability]:
        """The liabilities that were created from an order: at most one, unless something is wrong."""
        digest = message_hash(order)
        made = []
        async for block in self.chain.follow(self.started):
            for event in block.events:
                if isinstance(event, NewLiability):
                    liability, hashes = await self.chain.liabilities.get_with_orders(event.liability)
                    made += [liability] if digest in hashes else []
            if block.block_number >= await self.chain.block_number():
                return made
        raise AssertionError

    async def rejection_of(self, message: SignedMessage) -> Rejection:
        """Wait for the rejection of a message."""
        await until(lambda: self._rejections_of(message), what=f"a rejection of the {type(message).__name__}")
        assert self.rejected_makers[message_hash(message).hex()] == verify_message(message).signer.lower()
        return self._rejections_of(message)[0]

    def _rejections_of(self, message: SignedMessage) -> list[Rejection]:
        return [one for one in self.rejections if one.order == message_hash(message).hex()]

    def _rejected(self, sample: zenoh.Sample) -> None:
        rejection, key = Rejection.decode(sample.payload.to_bytes()), parse_key(str(sample.key_expr))
        assert isinstance(key, RejectKey)
        assert rejection.is_signed
        self.rejected_makers[rejection.order] = key.maker
        self.rejections.append(rejection)

    def _terms(self, changes: dict[str, Any]) -> dict[str, Any]:
        ours = {"token": self.deployment.xrt, "lighthouse": self.lighthouse, "cost": 0}
        return terms(**(ours | changes))
