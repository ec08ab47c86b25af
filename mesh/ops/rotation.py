"""A new key for a robot or a provider: orders withdrawn, contracts ended, money and stake moved, the old key retired.

Each step looks at what is left to do, on the chain or on the disk, so that a rotation that was interrupted anywhere is
completed by beginning it again. What can't be seen there is in a file beside the keyfile until the end: the new key's
address, whether the owner had paused the robot, the stake that is being moved, and the coin that is being sent.
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
from mesh.role.handover import handovers_to, keep_handover, retire
from mesh.role.local_stop import Hold, agents_here, control_here, stop_folder
from schemas.decoding import InvalidData, decode_json, first_line, text_of
from schemas.profiles import Handover
from schemas.records import ControlRobot

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from mesh.agent.components import AgentComponents
    from mesh.chain import Chain
    from mesh.settings import Settings

LOOK: Final = 1.0
"""Seconds between two looks at whether the contracts have ended, at least."""
RESERVE_PERCENT: Final = 125
"""Of the price of gas now: what sending the coin may cost when it is sent."""


class Journal(msgspec.Struct, frozen=True, kw_only=True):
    """What a rotation must remember. `stakes` are wn by lighthouse, `coin` is what is being sent, wei."""

    old: str
    new: str
    was_paused: bool | None = None
    stakes: dict[str, int] = {}
    coin: int | None = None


class RotationPlan(msgspec.Struct, frozen=True, kw_only=True):
    """What a rotation would do: numbers of orders and contracts, stake in wn, tokens by address, coin in wei."""

    old: str
    orders: int
    contracts: int
    stake: int
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

    `run` and `plan` raise `InputError` (`provider-running`), `RemoteError` (`contracts-open`), `ChainError`,
    `ConfigurationError`.
    """

    def __init__(self, settings: Settings, report: Callable[[str], None]) -> None:
        self._settings = settings
        self._report = report
        self._keyfile, self._password_file = settings.keyfile_and_password()
        self._journal_file = self._keyfile.with_name(f"{self._keyfile.name}.rotation")
        self._state = settings.state_directory
        self._moved: dict[str, int] = {}

    async def plan(self) -> RotationPlan:
        """What `run` would do now. Nothing is changed."""
        account = await asyncio.to_thread(Account.from_keyfile, self._keyfile, self._password_file)
        await self._check_provider(account.address)
        async with chain_of(self._settings, account) as chain:
            orders, contracts = 0, 0
            if (path := await self._ledger(chain, account.address)).exists():
                async with Ledger(path) as ledger:
                    head = await chain.contract_block()
                    orders = sum(_deadline(one.payload) > head for one in await ledger.orders())
                    contracts = len(await _open_contracts(chain, ledger, account.address, set()))
            state = await chain.lighthouses.get(self._settings.lighthouse_contract)
            return RotationPlan(
                old=account.address,
                orders=orders,
                contracts=contracts,
                stake=state.stakes.get(account.address, 0),
                tokens={
                    token: amount
                    for token in await self._tokens(chain)
                    if (amount := await chain.tokens.balance(token=token))
                },
                coin=await chain.tokens.eth_balance(),
            )

    async def run(self, *, timeout: float | None = None) -> Rotated:
        """Rotate the key, or complete a rotation that was interrupted; waits `timeout` seconds for open contracts."""
        old, new, journal = await asyncio.to_thread(self._begin)
        reached("begun")
        if old is not None:
            await self._check_provider(old.address)
            async with chain_of(self._settings, old) as chain:
                await self._end_work(chain, old, journal, timeout)
                journal = await self._withdraw_stake(chain, old, journal)
                await self._move_tokens(chain, journal)
                journal = await self._move_coin(chain, journal)
                left = await chain.tokens.eth_balance(old.address)
                await self._carry_settings(chain, journal)
                handover = Handover(agent=old.address, successor=new.address, time=int(time.time()))
                keep_handover(self._state, handover.signed_by(old.signer))
                reached("handed-over")
            await self._stake_again(new, journal)
            await asyncio.to_thread(self._exchange_keyfiles, journal)
            reached("exchanged")
        else:
            async with chain_of(self._settings, new) as chain:
                left = await chain.tokens.eth_balance(journal.old)
        retire(self._state, handovers_to(self._state, journal.new)[-1])
        self._journal_file.unlink()
        sync_directory(self._keyfile.parent)
        return Rotated(
            old=journal.old,
            new=journal.new,
            keyfile=str(self._keyfile),
            retired=str(self._retired(journal)),
            stake=sum(journal.stakes.values()),
            tokens=self._moved,
            coin=journal.coin or 0,
            left=left,
        )

    def _begin(self) -> tuple[Account | None, Account, Journal]:
        """The old account, unless its keyfile is exchanged already, the new one, and what is remembered. Blocks."""
        account = Account.from_keyfile(self._keyfile, self._password_file)
        journal = self._remembered()
        if journal is None:
            key = new_private_key()
            new = Account(key)
            password = text_of(first_line(self._password_file.read_bytes()))
            journal = Journal(old=account.address, new=new.address)
            write_keyfile(self._next(journal), key, password)
            self._remember(journal)
            self._report(f"the new address is {new.address}")
            return account, new, journal
        if account.address == journal.new:
            return None, account, journal
        if account.address != journal.old:
            raise ConfigurationError(
                f"{self._journal_file} is of {journal.old}, and the keyfile of {account.address}",
                hint="name the keyfile whose rotation was begun, or move that file away",
                code="rotation-of-another",
            )
        self._report(f"going on with the rotation to {journal.new}")
        return account, Account.from_keyfile(self._next(journal), self._password_file), journal

    def _remembered(self) -> Journal | None:
        try:
            return decode_json(self._journal_file.read_bytes(), Journal)
        except FileNotFoundError:
            return None
        except (OSError, InvalidData) as error:
            raise KeyfileError(self._journal_file, f"can't be used: {error}") from None

    def _remember(self, journal: Journal) -> None:
        try:
            with atomic_file(self._journal_file, private=True) as file:
                file.write(msgspec.json.encode(journal))
        except OSError as error:
            raise KeyfileError(self._journal_file, f"can't be written: {error.strerror}") from None

    def _next(self, journal: Journal) -> Path:
        return self._keyfile.with_name(f"{self._keyfile.name}.{journal.new}")

    def _retired(self, journal: Journal) -> Path:
        return self._keyfile.with_name(f"{self._keyfile.name}.retired-{journal.old}")

    async def _ledger(self, chain: Chain, address: str) -> Path:
        return await state_folder(self._settings, chain, address) / LEDGER

    async def _check_provider(self, address: str) -> None:
        async with watching(self._settings) as (_, channel):
            if await channel.present("provider", address.lower()):
                raise InputError(
                    f"the provider {address} is running",
                    hint="stop it, and start it again after the rotation",
                    code="provider-running",
                )

    async def _end_work(self, chain: Chain, old: Account, journal: Journal, timeout: float | None) -> None:
        """Let the robot take no jobs, withdraw its orders, and wait until its contracts have ended."""
        path = await self._ledger(chain, old.address)
        if not path.exists():  # it never traded here
            return
        async with working(self._settings, old, chain, drops=Drops()) as parts:
            if journal.was_paused is None:
                journal = replace(journal, was_paused=bool((await parts.ledger.control()).paused))
                self._remember(journal)
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

    async def _withdraw_stake(self, chain: Chain, old: Account, journal: Journal) -> Journal:
        lighthouse = await chain.lighthouses.get(self._settings.lighthouse_contract)
        if stake := lighthouse.stakes.get(old.address, 0):
            journal = replace(journal, stakes=journal.stakes | {lighthouse.address: stake})
            self._remember(journal)
            await chain.lighthouses.withdraw(lighthouse.address, stake)
            self._report("withdrew the stake")
        reached("stake-withdrawn")
        return journal

    async def _tokens(self, chain: Chain) -> list[str]:
        """The tokens (addresses) that are moved: XRT, that of the settings, and the chain's well-known ones."""
        named = [self._settings.erc20_token] if self._settings.erc20_token else []
        known = self._settings.profile.tokens.values()
        return list(dict.fromkeys([chain.xrt, *[await chain.names.address(one) for one in named], *known]))

    async def _move_tokens(self, chain: Chain, journal: Journal) -> None:
        for token in await self._tokens(chain):
            with suppress(NotOffered):
                if await chain.liabilities.owed(token):
                    await chain.liabilities.claim(token)
            if amount := await chain.tokens.balance(token=token):
                await chain.tokens.transfer(journal.new, amount, token=token)
                self._moved[token] = amount
                self._report(f"moved {(await chain.tokens.unit(token)).show(amount)}")
        reached("tokens-moved")

    async def _move_coin(self, chain: Chain, journal: Journal) -> Journal:
        """Send what is left after the transaction's own price; once begun, the same amount while it is there."""
        balance = await chain.tokens.eth_balance()
        if journal.coin is None or journal.coin > balance:
            call: Mapping[str, Any] = {"from": journal.old, "to": journal.new, "value": "0x1"}
            gas = await chain.node.estimate_gas(call) if balance else 0
            price = chain.node.fees.offer(await chain.node.gas_market()).maximum
            reserve = (gas + gas // 5) * price * RESERVE_PERCENT // 100 + 2 * await chain.node.data_fee(b"\1" * 100)
            if journal.coin is not None or balance <= reserve:
                reached("coin-moved")
                return journal
            journal = replace(journal, coin=balance - reserve)
            self._remember(journal)
        assert journal.coin is not None
        await chain.tokens.send_eth(journal.new, journal.coin)
        self._report("moved the coin")
        reached("coin-moved")
        return journal

    async def _carry_settings(self, chain: Chain, journal: Journal) -> None:
        """What the owner has changed while the robot ran, and whether it was stopped, counts for the new key, too."""
        before, after = await self._ledger(chain, journal.old), await self._ledger(chain, journal.new)
        if before.exists():
            make_private_folder(after.parent)
            async with Ledger(before) as old, Ledger(after) as new:
                await new.keep_control(replace(await old.control(), paused=journal.was_paused or None))
        folder = stop_folder(self._settings)
        if Hold(folder, journal.old).is_held:
            Hold(folder, journal.new).hold("the robot was stopped under its old key")

    async def _stake_again(self, new: Account, journal: Journal) -> None:
        async with chain_of(self._settings, new) as chain:
            for lighthouse, stake in journal.stakes.items():
                await chain.lighthouses.become_provider(lighthouse, stake)
                self._report("staked the same under the new key")
        reached("staked")

    def _exchange_keyfiles(self, journal: Journal) -> None:
        """Put the new keyfile into the place of the old one, which is kept under another name. Blocks."""
        retire_keyfile(self._keyfile, self._retired(journal), successor=journal.new)
        reached("retired")
        try:
            self._next(journal).replace(self._keyfile)
            sync_directory(self._keyfile.parent)
        except OSError as error:
            raise KeyfileError(self._keyfile, f"can't be replaced: {error.strerror}") from None


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
