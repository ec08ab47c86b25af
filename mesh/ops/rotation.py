"""A new key for a robot or a provider: orders withdrawn, contracts ended, money and stake moved, the old key retired.

Each step looks at what is left to do, on the chain or on the disk, so that a rotation that was interrupted anywhere is
completed by beginning it again. What can't be seen there is in a file beside the keyfile until the end: the new key's
address, whether the owner had paused the robot, the stake that is being moved, and the coin that is being sent.

The new keyfile takes its place before the money moves: so a provider of the new key can start, and be at work, while
that of the old key still is. The new key gets a stake before the old one's leaves, where there is XRT for two.
"""

from __future__ import annotations

import asyncio
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec.structs import replace

from mesh.agent.components import LEDGER, working
from mesh.agent.contracts import ContractReports
from mesh.agent.ledger import Ledger
from mesh.agent.orders import OrderState
from mesh.agent.trade import Trader
from mesh.amounts import XRT
from mesh.base.flood import Drops
from mesh.base.private_files import atomic_file, make_private_folder, sync_directory
from mesh.chain import (
    Account,
    KeyfileError,
    NotOffered,
    OrderAlreadyUsed,
    new_private_key,
    retire_keyfile,
    write_keyfile,
)
from mesh.errors import ConfigurationError, InputError, RemoteError
from mesh.role.composition import chain_of, state_folder, watching
from mesh.role.handover import handovers_to, keep_handover, retire, rotation_file
from mesh.role.local_stop import Hold, agents_here, control_here, stop_folder
from schemas.decoding import InvalidData, decode_json, first_line, text_of
from schemas.profiles import Handover
from schemas.records import ControlRobot

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping
    from pathlib import Path

    from mesh.agent.components import AgentComponents
    from mesh.chain import Chain, LighthouseState
    from mesh.errors import AiraError
    from mesh.network import Channel
    from mesh.settings import Settings

LOOK: Final = 1.0
"""Seconds between two looks at whether contracts have ended, or a provider runs, at least."""
GAP: Final = "five transactions and the start of the provider"
"""How long a lighthouse is without a provider whose stake leaves before its new key has one."""


class Journal(msgspec.Struct, frozen=True, kw_only=True):
    """What a rotation must remember.

    `stakes` are wn by lighthouse; `coin_ahead` and `coin` are what is being sent before and after the stakes move, wei.
    """

    old: str
    new: str
    was_paused: bool | None = None
    stakes: dict[str, int] = {}
    coin_ahead: int | None = None
    coin: int | None = None


class RotationPlan(msgspec.Struct, frozen=True, kw_only=True):
    """What a rotation would do: numbers of orders and contracts, stake in wn, tokens by address, coin in wei.

    `missing` is the wn more that a provider needs to move without a gap for its lighthouse.
    """

    old: str
    orders: int
    contracts: int
    stake: int
    missing: int
    tokens: dict[str, int]
    coin: int


class Rotated(msgspec.Struct, frozen=True, kw_only=True):
    """A rotation that is complete. `coin` is what was sent, and `left` what stays at the old address, wei."""

    old: str
    new: str
    keyfile: str
    retired: str
    stake: int
    tokens: dict[str, int]
    coin: int
    left: int


def reached(step: str) -> None:
    """A step of the rotation is complete; the tests end the process here."""


class Rotation:
    """One rotation of the account of some settings. `report` is called with a line for people at each step.

    `run` and `plan` raise `ChainError`, `ConfigurationError`; `run` also `InputError` (`provider-running`) and
    `RemoteError` (`contracts-open`, `provider-awaited`).
    """

    def __init__(self, settings: Settings, report: Callable[[str], None]) -> None:
        self._settings = settings
        self._report = report
        self._keyfile, self._password_file = settings.keyfile_and_password()
        self._journal_file = rotation_file(self._keyfile)
        self._state = settings.state_directory
        self._moved: dict[str, int] = {}

    async def plan(self) -> RotationPlan:
        """What `run` would do now. Nothing is changed."""
        account = await asyncio.to_thread(Account.from_keyfile, self._keyfile, self._password_file)
        async with chain_of(self._settings, account) as chain:
            orders, contracts = 0, 0
            if (path := await self._ledger(chain, account.address)).exists():
                async with Ledger(path) as ledger:
                    head = await chain.contract_block()
                    orders = sum(_deadline(one.payload) > head for one in await ledger.orders())
                    contracts = len(await _open_contracts(chain, ledger, account.address, set()))
            lighthouse = await self._lighthouse(chain)
            stake = lighthouse.stakes.get(account.address, 0)
            return RotationPlan(
                old=account.address,
                orders=orders,
                contracts=contracts,
                stake=stake,
                missing=await _missing(chain, lighthouse, account.address) if stake else 0,
                tokens={
                    token: amount
                    for token in await self._tokens(chain)
                    if (amount := await chain.tokens.balance(token=token))
                },
                coin=await chain.tokens.eth_balance(),
            )

    async def run(self, *, timeout: float | None = None) -> Rotated:
        """Rotate the key, or complete a rotation that was interrupted.

        Waits `timeout` seconds each for open contracts, for the new provider and for the end of the old one.
        """
        old, new = await asyncio.to_thread(self._begin)
        reached("begun")
        async with watching(self._settings) as (_, channel), chain_of(self._settings, old) as chain:
            if self._next.exists():  # or else it has its place already
                may_overlap = await self._may_overlap(channel, chain)
                await self._end_work(chain, old, timeout)
                if may_overlap:
                    await self._pay_ahead(chain, new)
                await self._carry_settings(chain)
                handover = Handover(agent=old.address, successor=new.address, time=int(time.time()))
                keep_handover(self._state, handover.signed_by(old.signer))
                reached("handed-over")
                await asyncio.to_thread(self._exchange_keyfiles)
                reached("exchanged")
            await self._stake_ahead(channel, chain, new, timeout)
            await self._withdraw_stake(chain)
            await self._wait_until_stopped(channel, timeout)
            await self._move_tokens(chain)
            await self._move_coin(chain)
            left = await chain.tokens.eth_balance(old.address)
        await self._stake(new, self._journal.stakes)
        reached("staked")
        retire(self._state, handovers_to(self._state, new.address)[-1])
        self._journal_file.unlink()
        sync_directory(self._keyfile.parent)
        return Rotated(
            old=old.address,
            new=new.address,
            keyfile=str(self._keyfile),
            retired=str(self._retired),
            stake=sum(self._journal.stakes.values()),
            tokens=self._moved,
            coin=(self._journal.coin_ahead or 0) + (self._journal.coin or 0),
            left=left,
        )

    def _begin(self) -> tuple[Account, Account]:
        """The old account and the new one, which is written down if the rotation is new. Blocks."""
        account = Account.from_keyfile(self._keyfile, self._password_file)
        journal = self._remembered()
        if journal is None:
            key = new_private_key()
            new = Account(key)
            password = text_of(first_line(self._password_file.read_bytes()))
            self._journal = Journal(old=account.address, new=new.address)
            write_keyfile(self._next, key, password)
            self._remember()
            self._report(f"the new address is {new.address}")
            return account, new
        self._journal = journal
        if account.address not in (journal.old, journal.new):
            raise ConfigurationError(
                f"{self._journal_file} is of {journal.old}, and the keyfile of {account.address}",
                hint="name the keyfile whose rotation was begun, or move that file away",
                code="rotation-of-another",
            )
        self._report(f"going on with the rotation to {journal.new}")
        if account.address == journal.new:
            return Account.from_retired_keyfile(self._retired, self._password_file), account
        return account, Account.from_keyfile(self._next, self._password_file)

    def _remembered(self) -> Journal | None:
        try:
            return decode_json(self._journal_file.read_bytes(), Journal)
        except FileNotFoundError:
            return None
        except (OSError, InvalidData) as error:
            raise KeyfileError(self._journal_file, f"can't be used: {error}") from None

    def _remember(self, **changes: Any) -> None:
        self._journal = replace(self._journal, **changes)
        try:
            with atomic_file(self._journal_file, private=True) as file:
                file.write(msgspec.json.encode(self._journal))
        except OSError as error:
            raise KeyfileError(self._journal_file, f"can't be written: {error.strerror}") from None

    @property
    def _next(self) -> Path:
        """The new keyfile, until it takes its place."""
        return self._keyfile.with_name(f"{self._keyfile.name}.{self._journal.new}")

    @property
    def _retired(self) -> Path:
        return self._keyfile.with_name(f"{self._keyfile.name}.retired-{self._journal.old}")

    async def _ledger(self, chain: Chain, address: str) -> Path:
        return await state_folder(self._settings, chain, address) / LEDGER

    async def _lighthouse(self, chain: Chain) -> LighthouseState:
        return await chain.lighthouses.get(self._settings.lighthouse_contract)

    async def _may_overlap(self, channel: Channel, chain: Chain) -> bool:
        """Whether the new key's provider can begin before the old one's ends; says so if their lighthouse has a gap.

        Raises `InputError` if the provider runs and has too little XRT for that: its owner stops it, or adds some.
        """
        lighthouse, old = await self._lighthouse(chain), self._journal.old
        if old not in lighthouse.stakes:
            return False
        missing = await _missing(chain, lighthouse, old, self._journal.new)
        why = f"{XRT.show(missing)} are missing to stake for the new key first" if missing else "it does not run"
        if not await _is_at_work(channel, old):
            self._report(f"the lighthouse is without this provider for {GAP}, because {why}")
            return False
        if missing:
            raise InputError(
                f"the provider {old} is running, and {why}",
                hint=f"send them to it; or stop it: its lighthouse is then without it for {GAP}",
                code="provider-running",
            )
        return True

    async def _end_work(self, chain: Chain, old: Account, timeout: float | None) -> None:
        """Let the robot take no jobs, withdraw its orders, and wait until its contracts have ended."""
        path = await self._ledger(chain, old.address)
        if not path.exists():  # it never traded here
            return
        async with working(self._settings, old, chain, drops=Drops()) as parts:
            if self._journal.was_paused is None:
                self._remember(was_paused=bool((await parts.ledger.control()).paused))
            await self._pause(parts)
            reached("paused")
            trader = Trader(parts, ContractReports(parts))
            await trader.load()
            for order in trader.orders(OrderState.OPEN, OrderState.WITHDRAWN):
                await order.withdraw()
                with suppress(NotOffered, OrderAlreadyUsed):  # then it is a contract by now, or can't be
                    tx = (await chain.liabilities.withdraw(order.message)).tx
                    await parts.ledger.use_up(order.hash, tx)
                    self._report(f"withdrew the {order.kind} {order.hash}")
            reached("withdrawn")
            await self._wait_for_contracts(parts, timeout)
        reached("ended")

    async def _pause(self, parts: AgentComponents) -> None:
        folder, asked = stop_folder(self._settings), ControlRobot(paused=True)
        control = await asyncio.to_thread(control_here, folder, parts.signer.address, asked)
        if control is None:
            await parts.ledger.keep_control(replace(await parts.ledger.control(), paused=True))
        self._report("the robot takes no new jobs")

    async def _wait_for_contracts(self, parts: AgentComponents, timeout: float | None) -> None:
        address, said = parts.signer.address, False
        known: set[str] = set()
        try:
            async with asyncio.timeout(timeout):
                while known := await _open_contracts(parts.chain, parts.ledger, address, known):
                    if not said:
                        said = True
                        runs = address in agents_here(stop_folder(self._settings))
                        start = "" if runs else "; start the robot, which does not run here with this data folder"
                        self._report(f"waiting for the end of {len(known)} of its contracts{start}")
                    await asyncio.sleep(max(LOOK, self._settings.poll_interval))
        except TimeoutError:
            raise RemoteError(
                f"{len(known)} contracts of {address} have not ended: {', '.join(sorted(known)[:4])}",
                hint="let the robot end its jobs, and repeat the command",
                code="contracts-open",
            ) from None

    async def _wait(
        self, is_over: Callable[[], Awaitable[bool]], words: str, timeout: float | None, *, late: AiraError
    ) -> None:
        """Say what the owner has to do, unless it is done, and wait for it; raise `late` when the time is over."""
        said = False
        try:
            async with asyncio.timeout(timeout):
                while not await is_over():
                    if not said:
                        said = True
                        self._report(words)
                    await asyncio.sleep(max(LOOK, self._settings.poll_interval))
        except TimeoutError:
            raise late from None

    async def _pay_ahead(self, chain: Chain, new: Account) -> None:
        """Give the new key what it needs for a stake: half of the coin, the minimal stake, and approval of the whole.

        If the old one has too little XRT besides its stake, it withdraws a part, and stays a provider.
        """
        lighthouse = await self._lighthouse(chain)
        if self._journal.old not in lighthouse.stakes:  # it has left since it was asked
            return
        least, stake = lighthouse.minimal_stake, lighthouse.stakes[self._journal.old]
        self._remember_stake(lighthouse)
        if self._journal.coin_ahead is None:
            self._remember(coin_ahead=await chain.tokens.eth_balance() // 2)
        if not await chain.tokens.eth_balance(new.address):
            assert self._journal.coin_ahead is not None
            await chain.tokens.send_eth(new.address, self._journal.coin_ahead)
        if (lacks := least - await _xrt(chain, lighthouse, new.address)) > 0:
            if await chain.tokens.balance() < lacks:
                # The same when it is repeated: then a transaction that may still be mined is waited for.
                await chain.lighthouses.withdraw(lighthouse.address, min(least, stake - least))
                self._report("withdrew a part of the stake")
            await chain.tokens.transfer(new.address, lacks)
        async with chain_of(self._settings, new) as own:
            whole = self._journal.stakes[lighthouse.address]
            if await own.tokens.allowance(new.address, lighthouse.address) < whole:
                await own.tokens.approve(lighthouse.address, whole)
        self._report("moved what the new key needs for a stake")
        reached("paid-ahead")

    async def _stake_ahead(self, channel: Channel, chain: Chain, new: Account, timeout: float | None) -> None:
        """If the new key has the means, stake for it as soon as its provider is at work, before the old stake leaves.

        Not sooner: while a provider that is not at work has the turn, the others wait.
        """
        lighthouse = await self._lighthouse(chain)
        if self._journal.old not in lighthouse.stakes:
            return
        if await _xrt(chain, lighthouse, new.address) < lighthouse.minimal_stake:
            return
        await self._wait(
            lambda: _is_at_work(channel, new.address),
            "start a second provider with the same settings: it has the new key",
            timeout,
            late=RemoteError(
                f"the provider {new.address} does not run",
                hint="start it with the same settings, which have the new key now, and repeat the command",
                code="provider-awaited",
            ),
        )
        await self._stake(new, {lighthouse.address: lighthouse.minimal_stake})
        reached("staked-ahead")

    async def _withdraw_stake(self, chain: Chain) -> None:
        # Again, if only an equal part was waited for.
        while stake := (lighthouse := await self._lighthouse(chain)).stakes.get(self._journal.old, 0):
            self._remember_stake(lighthouse)
            await chain.lighthouses.withdraw(lighthouse.address, stake)
            self._report("withdrew the stake")
        reached("stake-withdrawn")

    def _remember_stake(self, lighthouse: LighthouseState) -> None:
        """The stake that the new key gets in the end: that from before anything was withdrawn."""
        if lighthouse.address not in self._journal.stakes:
            stake = lighthouse.stakes[self._journal.old]
            self._remember(stakes=self._journal.stakes | {lighthouse.address: stake})

    async def _wait_until_stopped(self, channel: Channel, timeout: float | None) -> None:
        old = self._journal.old

        async def is_stopped() -> bool:
            return not await _is_at_work(channel, old)

        late = InputError(
            f"the provider {old} is running", hint="stop it, and repeat the command", code="provider-running"
        )
        await self._wait(is_stopped, f"stop the provider {old}", timeout, late=late)

    async def _tokens(self, chain: Chain) -> list[str]:
        """The tokens (addresses) that are moved: XRT, that of the settings, and the chain's well-known ones."""
        named = [self._settings.erc20_token] if self._settings.erc20_token else []
        known = self._settings.profile.tokens.values()
        return list(dict.fromkeys([chain.xrt, *[await chain.names.address(one) for one in named], *known]))

    async def _move_tokens(self, chain: Chain) -> None:
        for token in await self._tokens(chain):
            with suppress(NotOffered):
                if await chain.liabilities.owed(token):
                    await chain.liabilities.claim(token)
            for _ in range(2):  # the second time, if an equal one from before was waited for
                if not (amount := await chain.tokens.balance(token=token)):
                    break
                await chain.tokens.transfer(self._journal.new, amount, token=token)
                self._moved[token] = self._moved.get(token, 0) + amount
                self._report(f"moved {(await chain.tokens.unit(token)).show(amount)}")
        reached("tokens-moved")

    async def _move_coin(self, chain: Chain) -> None:
        """Send what is left after the transaction's own price; once begun, the same amount while it is there."""
        balance, coin = await chain.tokens.eth_balance(), self._journal.coin
        if coin is None or coin > balance:
            call: Mapping[str, Any] = {"from": self._journal.old, "to": self._journal.new, "value": "0x1"}
            gas = await chain.node.estimate_gas(call) if balance else 0
            price = chain.node.fees.offer(await chain.node.gas_market()).maximum
            # Sending the coin may cost a quarter more than now when it is sent.
            reserve = (gas + gas // 5) * price * 125 // 100 + 2 * await chain.node.data_fee(b"\1" * 100)
            if coin is not None or balance <= reserve:
                reached("coin-moved")
                return
            coin = balance - reserve
            self._remember(coin=coin)
        await chain.tokens.send_eth(self._journal.new, coin)
        self._report("moved the coin")
        reached("coin-moved")

    async def _carry_settings(self, chain: Chain) -> None:
        """What the owner has changed while the robot ran, and whether it was stopped, counts for the new key, too."""
        journal = self._journal
        before, after = await self._ledger(chain, journal.old), await self._ledger(chain, journal.new)
        if before.exists():
            make_private_folder(after.parent)
            async with Ledger(before) as old, Ledger(after) as new:
                await new.keep_control(replace(await old.control(), paused=journal.was_paused or None))
        folder = stop_folder(self._settings)
        if Hold(folder, journal.old).is_held:
            Hold(folder, journal.new).hold("the robot was stopped under its old key")

    async def _stake(self, new: Account, stakes: Mapping[str, int]) -> None:
        """Raise the stakes of the new key to these, wn by lighthouse."""
        async with chain_of(self._settings, new) as chain:
            for lighthouse, stake in stakes.items():
                staked = 0
                while staked < stake:  # again, if only an equal part was waited for
                    state = await chain.lighthouses.become_provider(lighthouse, stake)
                    staked = state.stakes.get(new.address, 0)
                self._report(f"the new key has a stake of {XRT.show(stake)}")

    def _exchange_keyfiles(self) -> None:
        """Put the new keyfile into the place of the old one, which is kept under another name. Blocks."""
        retire_keyfile(self._keyfile, self._retired, successor=self._journal.new)
        reached("retired")
        try:
            self._next.replace(self._keyfile)
            sync_directory(self._keyfile.parent)
        except OSError as error:
            raise KeyfileError(self._keyfile, f"can't be replaced: {error.strerror}") from None


async def _is_at_work(channel: Channel, provider: str) -> bool:
    return bool(await channel.present("provider", provider.lower()))


async def _xrt(chain: Chain, lighthouse: LighthouseState, account: str) -> int:
    """wn that an account has, staked or not."""
    return await chain.tokens.balance(account) + lighthouse.stakes.get(account, 0)


async def _missing(chain: Chain, lighthouse: LighthouseState, *accounts: str) -> int:
    """wn that accounts lack for two stakes at a time."""
    return max(2 * lighthouse.minimal_stake - sum([await _xrt(chain, lighthouse, one) for one in accounts]), 0)


async def _open_contracts(chain: Chain, ledger: Ledger, address: str, known: set[str]) -> set[str]:
    """The contracts of an account that have not ended: `known` ones, and those that its robot has not read yet.

    Without any that are known, those of the ledger.
    """
    found = set(known)
    if not known:
        found |= {job.liability.address for job in await ledger.jobs()}
        for kind in ("demand", "offer"):
            found |= {liability for _, liability in await ledger.contracts(kind)}
    block, _ = await ledger.cursor()
    if block is not None and block < await chain.block_number():
        for one in await chain.liabilities.list(from_block=block + 1):
            if address in (one.promisee, one.promisor):
                found.add(one.address)
    return set(await chain.liabilities.find_open(sorted(found)))


def _deadline(payload: bytes) -> int:
    from schemas import decode

    message: Any = decode(payload)
    return int(message.deadline)
