"""`aira order`: lists and withdraws open orders."""

from __future__ import annotations

import asyncio
from collections import defaultdict
from typing import TYPE_CHECKING, Any

import click

from mesh.cli.chain_client import notice_when_slow, open_chain, required_address, units_of
from mesh.cli.options import with_json, with_settings
from mesh.cli.output import plural, print_json, print_line, print_table
from mesh.errors import InputError
from mesh.settings import AccountSettings, ChainSettings, NetworkSettings
from schemas import parse_address
from schemas.decoding import decode_json

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from mesh.agent.components import AgentComponents
    from mesh.agent.ledger import StoredOrder
    from mesh.agent.trade import Order
    from mesh.chain import Chain
    from mesh.settings import Settings
    from schemas import Demand, Offer
    from schemas.signing import Rejection


@click.group("order")
def command() -> None:
    """The account's orders on this machine: demands and offers, open until they become contracts or expire."""


@command.command("list", short_help="list the open and withdrawn orders")
@with_json
@with_settings("keyfile", ChainSettings)
async def list_orders(settings: Settings, as_json: bool) -> None:
    """List the orders that may still become contracts: open ones, and withdrawn ones until their deadline.

    A `matched` one became a contract while no agent of the account ran; `aira liability list` shows it.
    """
    from schemas import decode, encode

    address = await asyncio.to_thread(required_address, settings)
    async with open_chain(settings) as chain:
        head = await chain.contract_block()
        found = []
        for stored in await _stored_orders(settings, chain, address):
            message: Any = decode(stored.payload)
            if message.deadline > head:
                found.append((stored, message, await _state(chain, stored, message, address)))
        units = await units_of(chain, [message for _, message, _ in found])
    if as_json:
        listed = []
        for stored, message, state in found:
            facts = {"hash": stored.identity, "kind": message.kind, "state": state, "posted": stored.posted}
            listed.append(facts | {"blocksLeft": message.deadline - head} | decode_json(encode(message)))
        print_json(listed)
    elif not found:
        print_line(f"no open orders of {address}")
    else:
        rows = []
        for stored, message, state in found:
            until = f"block {message.deadline:,}, in {plural(message.deadline - head, 'block')}"
            rows.append((stored.identity, message.kind, state, units[message.token].show(message.cost), until))
        print_table(("ORDER", "KIND", "STATE", "COST", "VALID UNTIL"), rows, numbers=("COST",))


async def _stored_orders(settings: Settings, chain: Chain, address: str) -> Sequence[StoredOrder]:
    """The orders in the account's ledger for this chain; none if it has no ledger."""
    from mesh.agent.components import LEDGER
    from mesh.agent.ledger import Ledger
    from mesh.role.composition import state_folder

    path = await state_folder(settings, chain, address) / LEDGER
    if not await asyncio.to_thread(path.exists):
        return ()
    async with Ledger(path) as ledger:
        return await ledger.orders()


async def _state(chain: Chain, stored: StoredOrder, message: Demand | Offer, address: str) -> str:
    if stored.is_withdrawn:
        return "withdrawn"
    is_used = await chain.liabilities.is_used(message, order_hash=bytes.fromhex(stored.identity), signer=address)
    return "matched" if is_used else "open"


@command.command("withdraw", short_help="withdraw open orders")
@click.argument("hashes", nargs=-1, metavar="[HASH]...")
@click.option("--all", "everything", is_flag=True, help="withdraw all open orders of the account")
@click.option("--on-chain", is_flag=True, help="also by a transaction, after which no provider can use the order")
@with_json
@with_settings(NetworkSettings, "lighthouse_contract", AccountSettings, ChainSettings)
async def withdraw(
    settings: Settings, hashes: tuple[str, ...], everything: bool, on_chain: bool, as_json: bool
) -> None:
    """Withdraw the open orders whose hashes begin with HASH.

    A signed withdrawal asks the providers not to use the order. A provider that is creating its contract now may still
    finish, and one that the withdrawal does not reach may use the order until its deadline. With --on-chain a
    transaction of the account excludes that.
    """
    if bool(hashes) == everything:
        raise click.UsageError("give the hashes of orders, or --all")
    from mesh.agent.components import working
    from mesh.agent.contracts import ContractReports
    from mesh.agent.orders import OrderState
    from mesh.agent.trade import Trader
    from mesh.base.flood import Drops
    from mesh.role.composition import load_account

    account = await asyncio.to_thread(load_account, settings)
    async with working(settings, account, None, drops=Drops()) as parts:
        trader = Trader(parts, ContractReports(parts))
        await trader.load()
        orders = trader.orders(OrderState.OPEN, OrderState.WITHDRAWN)
        parts.outbox.hold(order.hash for order in orders if order.state is OrderState.OPEN)
        chosen = orders if everything else [_named(orders, digits) for digits in hashes]
        facts = await withdraw_orders(parts, chosen, on_chain=on_chain)
    if as_json:
        print_json(facts)
        return
    for line in withdrawal_lines(facts):
        print_line(line)
    if not facts:
        print_line("no open orders")


def withdrawal_lines(facts: Sequence[dict[str, Any]]) -> Iterator[str]:
    """What people read of withdrawn orders."""
    for fact in facts:
        yield f"{fact['kind']} {fact['hash']} is withdrawn\n  {_what_it_means(fact)}"
        for provider in fact["honouredBy"]:
            yield f"  provider {provider} honours it"


async def withdraw_orders(parts: AgentComponents, orders: Sequence[Order], *, on_chain: bool) -> list[dict[str, Any]]:
    """Withdraw orders, and wait a moment for providers to confirm it; returns what is printed of each."""
    from mesh.agent.orders import OrderState
    from mesh.agent.trade import received_rejections
    from schemas.signing import Refusal

    honoured = defaultdict[str, set[str]](set)

    async def hear(rejection: Rejection) -> None:
        if rejection.reason == Refusal.WITHDRAWN:
            honoured[rejection.order].add(rejection.provider)

    async with received_rejections(parts, {order.hash for order in orders}, hear):
        withdrawn = [await order.withdraw() for order in orders]
        providers, facts = await _providers(parts), []
        for before, order in zip(orders, withdrawn, strict=True):
            told = honoured[order.hash] if before.state is OrderState.OPEN else None
            confirmed, tx = await _confirmations(parts, order, providers, told), None
            about = {"hash": order.hash, "kind": order.kind, "deadline": order.deadline, "providers": providers}
            about |= {"confirmedBy": confirmed, "honouredBy": sorted(honoured[order.hash])}
            if on_chain:
                with notice_when_slow():
                    tx = (await parts.chain.liabilities.withdraw(order.message)).tx
                await parts.ledger.use_up(order.hash, tx)
            facts.append(about | {"tx": tx})
        return facts


def _named(orders: Sequence[Order], digits: str) -> Order:
    """The order whose hash begins with these digits. Raises `InputError`."""
    found = [order for order in orders if order.hash.startswith(digits.lower().removeprefix("0x"))]
    if not found:
        raise InputError(
            f"no open order has the hash {digits[:70]}", hint="`aira order list` lists them", code="unknown-order"
        )
    if len(found) > 1:
        raise InputError(
            f"{len(found)} orders have hashes that begin with {digits}", hint="give more digits", code="invalid-options"
        )
    return found[0]


async def _confirmations(parts: AgentComponents, order: Order, providers: int, honoured: Collection[str] | None) -> int:
    """How many providers answer with the withdrawal when they are asked for it.

    Also waits until as many have `honoured` it; they say that once, so None for a withdrawal of an earlier run.
    """
    confirmed, deadline = 0, asyncio.get_running_loop().time() + parts.channel.answer_timeout

    def is_complete() -> bool:
        return confirmed >= providers and (honoured is None or len(honoured) >= providers)

    while not is_complete() and asyncio.get_running_loop().time() < deadline:
        confirmed = await asyncio.to_thread(_answers, parts, order)
        await asyncio.sleep(0 if is_complete() else 0.2)
        parts.outbox.send_due()
    return confirmed


async def _providers(parts: AgentComponents) -> int:
    """How many providers with a stake are present."""
    lighthouse = await parts.chain.lighthouses.get(parts.settings.lighthouse_contract)
    present = {parse_address(key.agent) for key in await parts.channel.present("provider")}
    return len(present & set(lighthouse.stakes))


def _answers(parts: AgentComponents, order: Order) -> int:
    """How many providers answer with the withdrawal of an order now."""
    import zenoh

    from schemas.keys import withdrawal_selector

    replies = parts.network.session.get(
        withdrawal_selector(parts.channel.lighthouse, order.hash),
        zenoh.handlers.FifoChannel(256),
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=parts.channel.answer_timeout / 2,
    )
    confirming = (reply for reply in replies if reply.ok is not None and _withdraws(reply.ok, parts, order))
    return len({str(reply.replier_id) for reply in confirming})


def _withdraws(sample: Any, parts: AgentComponents, order: Order) -> bool:
    """Whether a reply is the account's own withdrawal of the order. Others may withdraw equal terms of their own."""
    from schemas import InvalidMessage, Withdrawal, verify

    try:
        withdrawal = verify(sample.payload.to_bytes())
    except InvalidMessage:
        return False
    is_own = withdrawal.signer == parts.signer.address
    return isinstance(withdrawal.message, Withdrawal) and withdrawal.message.order == order.hash and is_own


def _what_it_means(fact: dict[str, Any]) -> str:
    if fact["tx"]:
        return f"No provider can use it any more: transaction {fact['tx']}."
    until = f"it may still become a contract before block {fact['deadline']:,}; --on-chain excludes that"
    if fact["providers"] and fact["confirmedBy"] >= fact["providers"]:
        who = plural(fact["providers"], "present provider")
        return f"Confirmed by {who}, which is all. If another one has the order, {until}."
    return f"{fact['confirmedBy']} of {plural(fact['providers'], 'present provider')} confirmed it: {until}."
