"""Ether, XRT and other ERC-20 tokens: `chain.tokens`; and who can pay for orders: `chain.funds`, `Allowances`.

What accounts have and let the factory take is asked of the chain in batches and remembered for a short time.
Anybody can sign orders with fresh keys, so hundreds of accounts are asked for in one request to the node. A token is
code of a stranger: each question has the gas of `TOKEN_LIMITS`, and one that fails says nothing about the others.
"""

from __future__ import annotations

import asyncio
import logging
import time
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.amounts import XRT, InvalidAmount, Unit, split_amount
from mesh.base.flood import BoundedDict
from mesh.base.log_context import log_event
from mesh.chain._abi import WORD, decode
from mesh.chain._permits import TOKEN_LIMITS, permit_fee
from mesh.chain.errors import InsufficientTokens, NoContracts, RequestRefused, Reverted
from mesh.chain.following import Approval, decode_log, topics_of
from mesh.errors import ChainError, InputError
from mesh.settings.chains import profile_of
from schemas.address import ZERO_ADDRESS, is_ens_name, shortened
from schemas.messages import Offer

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Hashable, Iterable, Mapping, Sequence

    from mesh.chain._abi import ContractFunctions
    from mesh.chain._contracts import Contracts
    from mesh.chain._node import Call, Node
    from mesh.chain._permits import Permits
    from schemas import Demand, Liability, Permit, Verified
    from schemas.messages import Order


log = logging.getLogger(__name__)


class FundsLimits(NamedTuple):
    """How often and how much the chain is asked what accounts have."""

    accounts: int = 256
    """In one request: the answers are 18 KB, of 24 that a node returns (EIP-170)."""
    requests: int = 4
    """At a time."""
    polls: float = 3
    """Intervals between polls of the chain for which an answer is used."""
    short_polls: float = 0.25
    """The same for an answer that there is too little: the maker may have paid in and sent its order at once."""
    remembered: int = 8192
    """Answers."""


FUNDS_LIMITS: Final = FundsLimits()

_BALANCE, _ALLOWANCE, _NONCES = (
    bytes.fromhex(selector) + bytes(12) for selector in ("70a08231", "dd62ed3e", "7ecebe00")
)
_DOMAIN: Final = bytes.fromhex("3644e515")


class Holding(NamedTuple):
    """A token and its holder, both addresses."""

    token: str
    account: str


class Funding(NamedTuple):
    """What an account has of a token, and what the factory may take of it, in the token's smallest unit."""

    balance: int
    allowance: int


NO_TOKEN: Final = Funding(-1, -1)
"""What anybody has of a contract that does not say what somebody has, as a token does: it can't be paid with."""


class _KnownFunding(NamedTuple):
    asked_at: float
    block: bytes | None
    """The latest block that was known then."""
    funding: Funding | None


class Funds:
    """What accounts have of tokens, and let the factory take; what orders cost, and whether their makers can pay it.

    Used in one event loop.
    """

    def __init__(self, contracts: Contracts, permits: Permits) -> None:
        self._contracts = contracts
        self._permits = permits
        self._known: BoundedDict[Holding, _KnownFunding] = BoundedDict(FUNDS_LIMITS.remembered)
        self._places = asyncio.Semaphore(FUNDS_LIMITS.requests)

    async def of(
        self, holdings: Iterable[Holding], *, within: float = FUNDS_LIMITS.polls, fresh: bool = False
    ) -> Mapping[Holding, Funding | None]:
        """What is known of holdings, read `within` that many poll intervals, in the latest block, or now.

        `NO_TOKEN` for what is no token, None if the node refuses to answer. Raises `NodeUnreachable`.
        """
        found: dict[Holding, Funding | None] = {}
        asked: list[Holding] = []
        latest = self._contracts.node.heads.latest
        now, block = time.monotonic(), None if latest is None else latest.hash
        for holding in dict.fromkeys(holdings):
            known = self._known.get(holding)
            if known is not None and not fresh and self._is_current(known, now, block, within):
                found[holding] = known.funding
            else:
                asked.append(holding)
        size = FUNDS_LIMITS.accounts
        parts = [asked[start : start + size] for start in range(0, len(asked), size)]
        for answers in await asyncio.gather(*map(self._ask, parts)):
            for holding, funding in answers:
                self._known[holding] = _KnownFunding(now, block, funding)
                found[holding] = funding
        return found

    def _is_current(self, known: _KnownFunding, now: float, block: bytes | None, within: float) -> bool:
        """Nothing changes between two blocks. But who is in a hurry may know of a block before we do."""
        node = self._contracts.node
        is_patient = within >= FUNDS_LIMITS.polls
        if is_patient and block is not None and block == known.block and node.heads.are_timely:
            return True
        return now < known.asked_at + within * node.timing.poll_interval

    def cost_of(self, order: Order) -> Mapping[str, int]:
        """What the factory may take from the maker of an order, by token, in the token's smallest unit."""
        if isinstance(order, Offer):
            return {self._contracts.xrt: order.lighthouse_fee}
        costs = {order.token: order.cost}
        charged = order.token if order.validator == ZERO_ADDRESS else self._contracts.xrt
        costs[charged] = costs.get(charged, 0) + order.validator_fee
        return costs

    def note(self, permit: Permit) -> bool:
        """Remember a signed permit, which counts as an allowance from now on; whether it is a better one."""
        is_better = self._permits.note(permit)
        if is_better:
            self._known.pop(Holding(permit.token, permit.owner), None)
        return is_better

    async def permit_for(self, demand: Verified[Demand]) -> Permit | None:
        """The permit to create a demand's contract with; None if it needs none, or none is known that may help.

        Raises `NodeUnreachable`, `RequestRefused`.
        """
        order, owner = demand.message, demand.signer
        if not self._permits.has_any_of(owner):
            return None
        node, fee, cost = self._contracts.node, permit_fee(order), self.cost_of(order)[order.token]
        functions = node.contract("XRT", order.token)
        asked = (
            functions.allowance(owner, self._contracts.factory),
            functions.nonces(owner),
            functions.DOMAIN_SEPARATOR(),
        )
        try:
            calls = [(order.token, one.data) for one in asked]
            answers = await node.call_all(calls, gas=TOKEN_LIMITS.gas, most=WORD)
        except (Reverted, NoContracts):
            return None
        allowed, nonce, domain = answers
        if allowed is None or nonce is None or domain is None:
            return None
        count = int.from_bytes(nonce)
        if (permit := self._permits.of(owner, domain, count)) is not None:
            return permit if fee or int.from_bytes(allowed) < cost else None
        # Somebody has brought it to the token, so the allowance stands; it still says that its owner pays the fee.
        return self._permits.of(owner, domain, count - 1) if fee else None

    async def shortages(self, orders: Sequence[Verified[Order]], *, fresh: bool = False) -> list[str]:
        """What each order's maker lacks to pay what the order costs it, as the contracts call it; empty if nothing.

        Without `fresh`, the answers may be a few poll intervals old. They are empty, too, if the node refuses them.
        Raises `NodeUnreachable`.
        """
        costs = [
            {Holding(token, order.signer): amount for token, amount in self.cost_of(order.message).items() if amount}
            for order in orders
        ]
        known = await self.of((holding for one in costs for holding in one), fresh=fresh)
        short = {holding for one in costs for holding, amount in one.items() if _lacks(known[holding], amount)}
        if short and not fresh:
            known = {**known, **await self.of(short, within=FUNDS_LIMITS.short_polls)}  # they may have paid in since
        return [
            next(filter(None, (_lacks(known[holding], amount) for holding, amount in one.items())), "") for one in costs
        ]

    def worth(self, order: Order | Liability, *, token: str = "") -> int:
        """The priority of an order, or of its liability, where there are too many: the magnitude of its cost.

        It is 0 unless the cost is in `token` (an address; XRT by default): anybody can make a token, and have any
        number of it.
        """
        return order.cost.bit_length() if order.token == (token or self._contracts.xrt) else 0

    async def _ask(self, batch: Sequence[Holding]) -> Iterable[tuple[Holding, Funding | None]]:
        async with self._places:
            return zip(batch, await self._read(batch), strict=True)

    async def _read(self, batch: Sequence[Holding]) -> list[Funding | None]:
        spender = bytes.fromhex(self._contracts.factory[2:])
        calls = []
        for token, holder in batch:
            account = bytes.fromhex(holder[2:])
            calls.append([(token, _BALANCE + account), (token, _ALLOWANCE + account + bytes(12) + spender)])
            if self._permits.has_any_of(holder):
                calls[-1] += [(token, _NONCES + account), (token, _DOMAIN)]
        answers = await asked_together(self._contracts.node, calls, most=WORD)
        return [
            None if one is None else self._permitted(holder, _funding(*one[:2]), *one[2:])
            for (_, holder), one in zip(batch, answers, strict=True)
        ]

    def _permitted(
        self, holder: str, funding: Funding, nonce: bytes | None = None, domain: bytes | None = None
    ) -> Funding:
        """Funding with the holder's permit as the allowance, if the token takes it by its nonce and domain."""
        if funding == NO_TOKEN or nonce is None or domain is None or len(nonce) != WORD:
            return funding
        permit = self._permits.of(holder, domain, int.from_bytes(nonce))
        return funding if permit is None else funding._replace(allowance=max(funding.allowance, permit.value))


async def asked_together(
    node: Node, calls: Sequence[Sequence[Call]], *, most: int
) -> list[Sequence[bytes | None] | None]:
    """What tokens answer to the calls for each of them, `most` bytes at most; None where the node refuses to answer.

    Half of them are asked at a time if it refuses all together, as when some tokens use up their gas.
    """
    try:
        answers = await node.call_all([call for each in calls for call in each], gas=TOKEN_LIMITS.gas, most=most)
    except (Reverted, RequestRefused) as error:
        if len(calls) == 1:
            log.debug("a token can't be read: %s", error)
            return [None]
        half = len(calls) // 2
        return [
            *await asked_together(node, calls[:half], most=most),
            *await asked_together(node, calls[half:], most=most),
        ]
    found = iter(answers)
    return [[next(found) for _ in each] for each in calls]


def _funding(balance: bytes | None, allowance: bytes | None) -> Funding:
    if balance is None or allowance is None or len(balance) != WORD or len(allowance) != WORD:
        return NO_TOKEN
    return Funding(int.from_bytes(balance), int.from_bytes(allowance))


TOKEN_UNREADABLE: Final = "TokenUnreadable"
"""The reason of a rejection when a contract does not tell balances and allowances, so that it can't be paid with."""


class AllowanceLimits(NamedTuple):
    """How many times what the open orders need is approved once contracts have used up an allowance, growing."""

    least: int = 4
    """The first time."""
    most: int = 16
    """At last."""


ALLOWANCE_LIMITS: Final = AllowanceLimits()


def _lacks(funding: Funding | None, amount: int) -> str:
    """What is missing to pay an amount; empty if nothing is, or nothing is known."""
    if funding is None or min(funding) >= amount:
        return ""
    if funding == NO_TOKEN:
        return TOKEN_UNREADABLE
    return "ERC20InsufficientAllowance" if funding.allowance < amount else "ERC20InsufficientBalance"


class Allowances:
    """The allowance of the factory: what the orders of `account` may cost, by order and token (smallest unit).

    With `permits` it may be signed instead of sent, where `is_carried` says that somebody will bring it to the token.
    """

    def __init__(
        self,
        tokens: Tokens,
        factory: str,
        account: str,
        permits: Permits | None = None,
        is_carried: Callable[[], Awaitable[bool]] | None = None,
    ) -> None:
        self._tokens = tokens
        self._permits = permits
        self._is_carried = is_carried
        self._factory = factory
        self._account = account
        self._open: dict[Hashable, Mapping[str, int]] = {}
        self._withdrawn: dict[Hashable, Mapping[str, int]] = {}
        self._approved: dict[str, int] = {}
        """By token: what this agent approved last."""
        self._ahead: dict[str, int] = {}
        self._approving = asyncio.Lock()

    async def ensure(
        self, order: Hashable, amounts: Mapping[str, int], *, permit: str = "", always: bool = False
    ) -> None:
        """Make sure that the factory may take `amounts` (by token) for `order` and what the other orders may cost.

        What lacks of the token `permit` (an address) is approved by a signature, which `permits` has then, if the token
        takes such; else, and of other tokens, by a transaction. With `always` it is signed also if nothing lacks.

        The account must own what its open orders cost; withdrawn ones only need the allowance. Raises
        `InsufficientTokens`; a new order is then not counted.
        """
        async with self._approving:
            for token, amount in amounts.items():
                if amount:
                    others = (costs for key, costs in self._open.items() if key != order)
                    funds = amount + _sum(others, token)
                    needed = funds + _sum(self._withdrawn.values(), token)
                    is_permitted = token == permit
                    await self._ensure(token, funds=funds, needed=needed, is_permitted=is_permitted, always=always)
            if order not in self._withdrawn:
                self._open[order] = amounts

    def count(self, order: Hashable, amounts: Mapping[str, int]) -> None:
        """Count an order of an earlier run, whose allowance was approved then."""
        self._open[order] = amounts

    def withdraw(self, order: Hashable) -> None:
        """Count an order that is withdrawn, but may become a contract all the same."""
        if order in self._open:
            self._withdrawn[order] = self._open.pop(order)

    def release(self, order: Hashable) -> None:
        """Stop counting an order that can't become a contract any more. Unknown ones are ignored."""
        self._open.pop(order, None)
        self._withdrawn.pop(order, None)

    async def _ensure(self, token: str, *, funds: int, needed: int, is_permitted: bool, always: bool) -> None:
        factory, tokens = self._factory, self._tokens
        balance, allowed = await tokens.balance_and_allowance(self._account, factory, token=token)
        if balance < funds:
            raise InsufficientTokens(self._account, token, balance=balance, needed=funds)
        is_signed = is_permitted and (always or (allowed < needed and await self._are_carried()))
        if is_signed and self._permits is not None and await self._permits.sign(token, needed) is not None:
            facts = log_event("permit-signed", token=token, amount=needed)
            log.info("signed a permit for %d of token %s, so no transaction is needed", needed, token, extra=facts)
            return
        while allowed < needed:
            allowance = max(needed, min(self._times(token, allowed) * needed, balance))
            facts = log_event("allowance-approved", token=token, amount=allowance)
            log.info("approving an allowance of %d of token %s for the factory", allowance, token, extra=facts)
            try:
                await tokens.approve(factory, allowance, token=token)
                self._approved[token] = allowance
            except Reverted as error:
                if error.reason != "OutOfGas":
                    raise
                # An order became a contract between estimate and block: setting a used-up allowance costs more gas.
                facts = log_event("allowance-retried", token=token, amount=allowance)
                log.info("approving the allowance again: %s", error, extra=facts)
            allowed = await tokens.allowance(self._account, factory, token=token)

    async def _are_carried(self) -> bool:
        return self._is_carried is None or await self._is_carried()

    def _times(self, token: str, allowed: int) -> int:
        """How many times what is needed is approved: more and more, when contracts have used up what was approved.

        A transaction for each order would cost more than the order.
        """
        if allowed < self._approved.get(token, 0):
            ahead = max(ALLOWANCE_LIMITS.least, 2 * self._ahead.get(token, 0))
            self._ahead[token] = min(ahead, ALLOWANCE_LIMITS.most)
        return self._ahead.get(token, 1)


def _sum(orders: Iterable[Mapping[str, int]], token: str) -> int:
    return sum(costs.get(token, 0) for costs in orders)


_SYMBOL, _DECIMALS, _SUPPLY = (bytes.fromhex(selector) for selector in ("95d89b41", "313ce567", "18160ddd"))


class Amounts(NamedTuple):
    """Amounts of one token (its address), each a number of its smallest unit."""

    token: str
    unit: Unit
    values: Sequence[int]


class Tokens:
    """Balances, allowances and transfers. The default token is XRT, the default account one's own."""

    def __init__(self, contracts: Contracts) -> None:
        self._contracts, self._node, self._address = contracts, contracts.node, contracts.names.address
        profile = contracts.node.profile
        known = (profile if profile.tokens else profile_of(contracts.node.chain_id) or profile).tokens
        self._known: Mapping[str, str] = {XRT.symbol: contracts.xrt, **known}
        """The addresses of well-known tokens by their symbols."""
        self._units: BoundedDict[str, Unit] = BoundedDict(1024)

    async def address(self, named: str) -> str:
        """The address of a token: of a well-known one by its symbol (XRT, and those of the chain's profile), of any
        other by its address or ENS name.

        Raises `InputError` (`unknown-token`), `InvalidAddress`, `UnknownName`, `NodeUnreachable`.
        """
        found = next((known for symbol, known in self._known.items() if symbol.lower() == named.lower()), None)
        if found is not None:
            return found
        if named[:2].lower() == "0x" or is_ens_name(named):
            return await self._address(named)
        raise InputError(
            f"{named[:40]!r} is no token that is known here",
            hint=f"known are {', '.join(self._known)}; name any other by its address",
            code="unknown-token",
        )

    async def amounts(self, *given: int | str, token: str = "", default: str = "") -> Amounts:
        """Amounts of one token: that which they name (`3.50 USDC`, `3.50 0x…`), else `token`, else `default`, else XRT.

        Tokens are named as for `address`; `token` and `default` also by the symbol that they give themselves. Numbers
        count the smallest unit. Raises `InvalidAmount`, also for amounts of several tokens, and as `address` and
        `unit` do.
        """
        split = [split_amount(one) if isinstance(one, str) else None for one in given]
        usual = await self.address(token or default or XRT.symbol)
        found = {usual} if token else set()
        for _, name in filter(None, split):
            if name and name.lower() != "units":
                found.add(await self._named(name, usual))
        if len(found) > 1:
            units = await self.units(found)
            tokens = " and ".join(units[one].symbol for one in found)
            raise InvalidAmount(f"amounts of two tokens, {tokens}, stand for one", hint="write all in one token")
        address = next(iter(found), usual)
        unit = await self.unit(address) if any(split) else (await self.units([address]))[address]
        values = []
        for one, parts in zip(given, split, strict=True):
            number, name = parts or ("", "")
            smallest = name if name.lower() in ("units", unit.smallest) else ""
            values.append(unit.amount(one) if parts is None else unit.parse(number + smallest))
        return Amounts(address, unit, values)

    async def _named(self, name: str, usual: str) -> str:
        """The token that an amount names; its own symbol is enough for the usual one, if no known token has it."""
        if name.lower() == XRT.smallest:
            return self._contracts.xrt
        try:
            return await self.address(name)
        except InputError as error:
            if error.code != "unknown-token":
                raise
            own = (await self.units([usual]))[usual].symbol.partition(" (")[0]
            if own.lower() != name.lower():
                raise
            return usual

    def price(self, amount: int, token: str, unit: Unit) -> str:
        """A price as profiles and descriptions say it, with the symbol of a known token, else its address."""
        return f"{unit.decimal(amount)} {self._known_symbol(token) or token}"

    def _known_symbol(self, token: str) -> str:
        return next((symbol for symbol, known in self._known.items() if known == token), "")

    async def eth_balance(self, address: str | None = None) -> int:
        """Wei of an account; of one's own by default."""
        return await self._node.eth_balance(await self._contracts.address_or_own(address))

    async def send_eth(self, to: str, value: int) -> str:
        """Send `value` wei; the transaction's hash."""
        return (await self._contracts.signing().send(to=await self._address(to), data=b"", value=value)).tx

    async def supply(self, token: str | None = None) -> int:
        """Units of a token (XRT by default) that there are. Raises `NoContracts` for an address without a token."""
        return int(await self._node.read((await self._token(token)).totalSupply()))

    async def unit(self, token: str | None = None) -> Unit:
        """The unit that a token is counted in (named as for `address`; XRT by default), asked of the chain once.

        Anybody can choose any symbol, so one that is not well-known has its address in it. Raises `ChainError`
        (`not-a-token`) and as `address` does.
        """
        address = self._contracts.xrt if token is None else await self.address(token)
        await self.units([address])
        if address not in self._units:
            raise ChainError(
                f"{token or address} is not a token",
                hint="name an ERC-20 by its address or ENS name",
                code="not-a-token",
            )
        return self._units[address]

    async def units(self, tokens: Iterable[str]) -> dict[str, Unit]:
        """The units of tokens (addresses), to show amounts; of one that does not say it, its smallest unit.

        Raises `NodeUnreachable`.
        """
        wanted = list(dict.fromkeys(tokens))
        found = {token: self._units[token] for token in wanted if token in self._units}
        asked = [token for token in wanted if token not in found]
        for start in range(0, len(asked), TOKEN_LIMITS.asked):
            some = asked[start : start + TOKEN_LIMITS.asked]
            calls = [[(token, _SYMBOL), (token, _DECIMALS), (token, _SUPPLY)] for token in some]
            answered = await asked_together(self._node, calls, most=TOKEN_LIMITS.text)
            for token, answers in zip(some, answered, strict=True):
                if answers is None or answers[2] is None or len(answers[2]) < WORD:
                    found[token] = Unit(f"units of {shortened(token)}", 0)
                else:
                    found[token] = self._units[token] = self._unit_of(token, answers[0] or b"", answers[1] or b"")
        return found

    def _unit_of(self, token: str, symbol: bytes, decimals: bytes) -> Unit:
        """The unit of a token by what it answers; its symbol counts only together with its address."""
        if known := self._known_symbol(token):
            return Unit(known, _decimals(decimals), XRT.smallest if token == self._contracts.xrt else "units")
        label = _label(symbol)[: TOKEN_LIMITS.symbol].strip() or ("tokens" if _decimals(decimals) else "units")
        return Unit(f"{label} ({shortened(token)})", _decimals(decimals))

    async def balance(self, address: str | None = None, *, token: str | None = None) -> int:
        """Units of a token (XRT by default) that an account holds."""
        account = await self._contracts.address_or_own(address)
        return int(await self._node.read((await self._token(token)).balanceOf(account)))

    async def allowance(self, owner: str, spender: str, *, token: str | None = None) -> int:
        """Units of a token (XRT by default) that `spender` may take from `owner`."""
        functions, owner = await self._token(token), await self._address(owner)
        return int(await self._node.read(functions.allowance(owner, await self._address(spender))))

    async def balance_and_allowance(self, owner: str, spender: str, *, token: str | None = None) -> tuple[int, int]:
        """The same as `balance` and `allowance`, in one call."""
        functions, owner = await self._token(token), await self._address(owner)
        calls = (functions.balanceOf(owner), functions.allowance(owner, await self._address(spender)))
        balance, allowance = await self._node.read_all(calls, block="latest")
        return int(balance), int(allowance)

    async def approved(self, owner: str, first: int, last: int, *, token: str | None = None) -> set[str]:
        """Whom an owner allowed, in the blocks from `first` to `last`, to take units of a token (XRT by default).

        They may have taken all since, or the owner may have taken it back. A machine of the node that is behind leaves
        the last ones out. Raises `RequestRefused`, also because these are too many blocks for the node.
        """
        address, owner = (await self._token(token)).address, await self._address(owner)
        logs = await self._node.logs(first, last, addresses=[address], topics=topics_of("XRT"), about=owner)
        events = [decode_log(log) for log in logs if log.address == address]
        return {event.spender for event in events if isinstance(event, Approval) and event.owner == owner}

    async def approve(self, spender: str, value: int, *, token: str | None = None) -> str:
        """Let `spender` take up to `value` units of a token (XRT by default); the transaction's hash."""
        call = (await self._token(token)).approve(await self._address(spender), value)
        return (await self._contracts.send(call)).tx

    async def transfer(self, to: str, value: int, *, token: str | None = None) -> str:
        """Send units of a token (XRT by default); the transaction's hash."""
        call = (await self._token(token)).transfer(await self._address(to), value)
        return (await self._contracts.send(call)).tx

    async def transfer_from(self, owner: str, to: str, value: int, *, token: str | None = None) -> str:
        """Send what `owner` approved for this account; the transaction's hash."""
        functions, owner = await self._token(token), await self._address(owner)
        return (await self._contracts.send(functions.transferFrom(owner, await self._address(to), value))).tx

    async def _token(self, token: str | None) -> ContractFunctions:
        address = self._contracts.xrt if token is None else await self.address(token)
        return self._node.contract("XRT", address)


def _label(answer: bytes) -> str:
    """A printable text. Old tokens return 32 bytes instead of a string."""
    try:
        text = answer.rstrip(b"\0").decode() if len(answer) == 32 else decode(["string"], answer)[0]
    except ValueError:
        return ""
    return "".join(character for character in text if character.isprintable())[: TOKEN_LIMITS.label].strip()


def _decimals(answer: bytes) -> int:
    value = int.from_bytes(answer, "big") if len(answer) == 32 else 0
    return value if value <= TOKEN_LIMITS.decimals else 0
