"""The account: its keyfile and password, what it holds, and what the contracts may take from it."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.chain import Account
from mesh.doctor.checks import aside
from mesh.doctor.findings import Finding, broken, doubtful, sound
from mesh.market.transaction_queue import LEAST_GAS

if TYPE_CHECKING:
    from mesh.doctor.case import Case
    from mesh.doctor.chain import Ledgers

READ_BY_OTHERS: Final = stat.S_IRGRP | stat.S_IROTH
SECRETS: Final = tuple(map(Path, ("/run/secrets", "/run/credentials", "/secrets")))
"""Where containers and systemd's units have their secrets; who could read them there is nobody else."""
DIGITS: Final = 9
"""Decimals that are shown, of ether's eighteen."""
AMPLE: Final = 20
"""Transactions for which there should be ETH."""


class Coin(NamedTuple):
    """What an amount is an amount of, and how many decimals of it there are."""

    symbol: str
    decimals: int


ETH: Final = Coin("ETH", 18)
XRT: Final = Coin("XRT", 9)


class Purse:
    """The account of the settings' keyfile, and what it holds on an open chain."""

    def __init__(self, case: Case, ledgers: Ledgers) -> None:
        self._case = case
        self._ledgers = ledgers
        self.address = ""
        """EIP-55, once the keyfile was opened."""

    async def check_keyfile(self) -> Finding:
        """That the password opens the keyfile, and that others read neither. Raises `KeyfileError`, `WrongPassword`."""
        files = self._case.settings.keyfile_and_password()
        self.address = (await aside(Account.from_keyfile, *files)).address
        readable = [path for path in files if _is_read_by_others(path)]
        if readable:
            names = " and ".join(map(str, readable))
            closing = f"chmod 600 {' '.join(map(str, readable))}"
            return doubtful(f"{self.address}, but others on this machine may read {names}", do=closing)
        return sound(f"{self.address}, the password opens {files[0]}")

    async def check_ether(self) -> Finding:
        """That gas can be paid. Raises `FeeTooHigh`."""
        node = self._ledgers.node
        balance = await node.eth_balance(self.address)
        await node.fees.fees(node)
        one = LEAST_GAS * int(await node.web3.eth.gas_price)
        count = balance // one if one else AMPLE
        shown = f"{self.address} has {_amount(balance, ETH)}"
        if count >= AMPLE:
            return sound(f"{shown}: gas for {'more than 1,000' if count > 1000 else f'{count:,}'} transactions")
        if count >= 1:
            return doubtful(f"{shown}: gas for {count} transactions, and no more", do="send it ETH; gas is paid in it")
        if self._case.role == "agent":
            return doubtful(
                f"{shown}: gas for no transaction",
                do="send it ETH if it is to agree to fees, or to call off jobs; to work and be paid it needs none",
            )
        return broken(f"{shown}: gas for no transaction", do=f"send it {at_least(AMPLE * one, ETH)} or more for gas")

    async def check_tokens(self) -> Finding:
        """That there is something to pay with."""
        coin, balance = await self._coin(), await self._balance()
        shown = f"{self.address} has {_amount(balance, coin)}"
        if balance or self._case.role != "person":
            return sound(shown)
        return broken(f"{shown}: nothing to pay a job with", do=f"send it {coin.symbol}: `aira xrt transfer` does")

    async def check_allowance(self) -> Finding:
        """That the factory may take what a job costs, or that it can be allowed to."""
        chain, coin = self._ledgers.chain, await self._coin()
        allowed = await chain.tokens.allowance(self.address, chain.factory, token=self._case.settings.erc20_token)
        if allowed:
            return sound(f"the factory may take {_amount(allowed, coin)}")
        node = chain.node
        approve = "`aira xrt approve factory AMOUNT`"
        if await node.eth_balance(self.address) < LEAST_GAS * int(await node.web3.eth.gas_price):
            return broken(
                f"the factory may take no {coin.symbol} from {self.address}, which has no ETH to allow it",
                do=f"send it ETH for gas; `aira demand` then allows what a job costs, or {approve} does",
            )
        return doubtful(
            f"the factory may take no {coin.symbol} from {self.address} yet",
            do=f"{approve}; `aira demand` and agents do so by themselves, for what a job costs",
        )

    async def check_stake(self) -> Finding:
        """That the account may send transactions to its lighthouse. Raises `NoStake`."""
        from mesh.market.transaction_queue import NoStake

        chain, name = self._ledgers.chain, self._case.settings.lighthouse_contract
        state = await chain.lighthouses.get(name)
        if self.address not in state.stakes:
            raise NoStake(self.address, name, minimal_stake=state.minimal_stake)
        stake = state.stakes[self.address]
        count = stake // state.minimal_stake if state.minimal_stake else 0
        return sound(f"{_amount(stake, XRT)} at {name}: {count:,} transaction{'' if count == 1 else 's'} a turn")

    async def check_turn(self) -> Finding:
        """Whose turn it is; others may be next."""
        chain = self._ledgers.chain
        state = await chain.lighthouses.get(self._case.settings.lighthouse_contract)
        block, providers = await chain.block_number(), list(state.stakes)
        if state.current == self.address:
            return sound(f"its own, {state.quota:,} transactions left of it")
        place = f"{providers.index(state.current) + 1} of {len(providers)}" if state.current in providers else "gone"
        alive = f"who was heard of {block - state.keep_alive_block:,} blocks ago"
        alive = alive if state.keep_alive_block else "who was not heard of yet"
        may = "may send now" if await chain.lighthouses.is_turn(state.address, self.address) else "waits for its turn"
        return sound(f"{state.current}'s ({place}), {alive}; this account {may}")

    async def _coin(self) -> Coin:
        token = await self._ledgers.chain.tokens.info(self._case.settings.erc20_token)
        return Coin(token.symbol or "tokens", token.decimals)

    async def _balance(self) -> int:
        return await self._ledgers.chain.tokens.balance(self.address, token=self._case.settings.erc20_token)


def _amount(count: int, coin: Coin) -> str:
    """So many of a coin's smallest unit; of its decimals no more than people count with."""
    whole, part = divmod(count, 10**coin.decimals)
    digits = f"{part:0{coin.decimals}}"[:DIGITS].rstrip("0") if coin.decimals else ""
    return f"{whole:,}{'.' if digits else ''}{digits} {coin.symbol}"


def at_least(count: int, coin: Coin) -> str:
    """So many of a coin's smallest unit, or a little more: what is shown is never too little."""
    last = 10 ** max(0, coin.decimals - DIGITS)
    return _amount(-(-count // last) * last, coin)


def _is_read_by_others(path: Path) -> bool:
    if os.name != "posix" or any(map(path.is_relative_to, SECRETS)):
        return False
    return bool(path.stat().st_mode & READ_BY_OTHERS)
