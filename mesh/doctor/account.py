"""The account: its keyfile and password, its balances, allowance, stake and turn."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.chain import Account
from mesh.doctor.checks import CheckResult, failed, in_thread, passed, warning
from mesh.market.transaction_queue import LEAST_GAS

if TYPE_CHECKING:
    from mesh.doctor.chain import ChainChecks
    from mesh.doctor.context import DoctorContext

READ_BY_OTHERS: Final = stat.S_IRGRP | stat.S_IROTH
SECRETS: Final = tuple(map(Path, ("/run/secrets", "/run/credentials", "/secrets")))
"""Folders in which containers and systemd units get secrets; no other user can read them."""
DIGITS: Final = 9
"""Decimals shown of an amount; ether has eighteen."""
AMPLE: Final = 20
"""Number of transactions for which the account should have ETH."""


class Currency(NamedTuple):
    """A token's symbol and its number of decimals."""

    symbol: str
    decimals: int


ETH: Final = Currency("ETH", 18)
XRT: Final = Currency("XRT", 9)


class AccountChecks:
    """The checks of the account in the settings' keyfile. All but the keyfile's need an open chain."""

    def __init__(self, context: DoctorContext, chain_checks: ChainChecks) -> None:
        self._context = context
        self._chain_checks = chain_checks
        self.address = ""
        """EIP-55; empty until the keyfile is decrypted."""

    async def check_keyfile(self) -> CheckResult:
        """Whether the password decrypts the keyfile, and no other user can read either.

        Raises `KeyfileError`, `WrongPassword`.
        """
        files = self._context.settings.keyfile_and_password()
        self.address = (await in_thread(Account.from_keyfile, *files)).address
        readable = [path for path in files if _is_read_by_others(path)]
        if readable:
            names = " and ".join(map(str, readable))
            hint = f"chmod 600 {' '.join(map(str, readable))}"
            return warning(
                f"{self.address}, but other users of this machine can read {names}", code="keyfile-readable", hint=hint
            )
        return passed(f"{self.address}, the password decrypts {files[0]}")

    async def check_ether(self) -> CheckResult:
        """Whether the account can pay gas. Raises `FeeTooHigh`."""
        node = self._chain_checks.node
        balance = await node.eth_balance(self.address)
        node.fees.offer(await node.gas_market())
        one = LEAST_GAS * await node.gas_price()
        count = balance // one if one else AMPLE
        shown = f"{self.address} has {_amount(balance, ETH)}"
        if count >= AMPLE:
            return passed(f"{shown}: gas for {'more than 1,000' if count > 1000 else f'{count:,}'} transactions")
        if count >= 1:
            return warning(
                f"{shown}: gas for only {count} transactions", code="little-gas", hint="send it ETH to pay for gas"
            )
        if self._context.role == "agent":
            return warning(
                f"{shown}: not enough gas for a transaction",
                code="no-gas",
                hint="send it ETH if it should approve fees or cancel jobs; working and being paid needs none",
            )
        if self._context.role == "validator" and self._context.settings.validator_contract:
            return passed(f"{shown}: judging for a contract needs none")
        return failed(
            f"{shown}: not enough gas for a transaction",
            code="no-gas",
            hint=f"send it at least {at_least(AMPLE * one, ETH)}",
        )

    async def check_tokens(self) -> CheckResult:
        """Whether the account has tokens to pay with."""
        coin, balance = await self._coin(), await self._balance()
        shown = f"{self.address} has {_amount(balance, coin)}"
        if balance or self._context.role != "person":
            return passed(shown)
        return failed(
            f"{shown}: it can't pay for a job",
            code="no-tokens",
            hint=f"send it {coin.symbol}, for example with `aira xrt transfer`",
        )

    async def check_allowance(self) -> CheckResult:
        """Whether the factory may transfer the cost of a job, or the account can pay gas to allow it."""
        chain, coin = self._chain_checks.chain, await self._coin()
        allowed = await chain.tokens.allowance(self.address, chain.factory, token=self._context.settings.erc20_token)
        if allowed:
            return passed(f"the factory may transfer {_amount(allowed, coin)}")
        node = chain.node
        approve = "`aira xrt approve factory AMOUNT`"
        if await node.eth_balance(self.address) < LEAST_GAS * await node.gas_price():
            return failed(
                f"the factory may not transfer {coin.symbol} of {self.address}, which has no ETH to approve it",
                code="no-allowance",
                hint=f"send it ETH for gas; then `aira demand` approves the cost of a job, or use {approve}",
            )
        return warning(
            f"the factory may not transfer {coin.symbol} of {self.address} yet",
            code="no-allowance",
            hint=f"`aira demand` and agents approve the cost of each job; to approve more, use {approve}",
        )

    async def check_stake(self) -> CheckResult:
        """Whether the account has a stake at its lighthouse. Raises `NoStake`."""
        from mesh.market.turns import NoStake

        chain, name = self._chain_checks.chain, self._context.settings.lighthouse_contract
        state = await chain.lighthouses.get(name)
        if self.address not in state.stakes:
            raise NoStake(self.address, name, minimal_stake=state.minimal_stake)
        stake = state.stakes[self.address]
        count = stake // state.minimal_stake if state.minimal_stake else 0
        return passed(f"{_amount(stake, XRT)} at {name}: {count:,} transaction{'' if count == 1 else 's'} per turn")

    async def check_turn(self) -> CheckResult:
        """Whose turn it is at the lighthouse."""
        chain = self._chain_checks.chain
        state = await chain.lighthouses.get(self._context.settings.lighthouse_contract)
        block, providers = await chain.block_number(), list(state.stakes)
        if state.current == self.address:
            return passed(f"its own, with {state.quota:,} transactions left", code="own-turn")
        place = f"{providers.index(state.current) + 1} of {len(providers)}" if state.current in providers else "left"
        active = f"last active {block - state.keep_alive_block:,} blocks ago"
        active = active if state.keep_alive_block else "not active yet"
        may = "may send now" if await chain.lighthouses.is_turn(state.address, self.address) else "waits for its turn"
        return passed(f"{state.current} ({place}), {active}; this account {may}", code="other-turn")

    async def check_validator(self) -> CheckResult:
        """Whether the account may judge for the contract of the settings. Raises `NotAValidator`, `NotAJuror`."""
        from mesh.validator.components import bench_of

        contract = self._context.settings.validator_contract
        if not contract:
            return passed(f"{self.address} judges for itself (generation 3)", code="own-account")
        bench = await bench_of(self._chain_checks.chain, self.address, contract)
        return passed(f"{self.address} is a juror of {bench.contract}: {bench.quorum} of {bench.jurors} must agree")

    async def _coin(self) -> Currency:
        token = await self._chain_checks.chain.tokens.info(self._context.settings.erc20_token)
        return Currency(token.symbol or "tokens", token.decimals)

    async def _balance(self) -> int:
        return await self._chain_checks.chain.tokens.balance(self.address, token=self._context.settings.erc20_token)


def _amount(count: int, coin: Currency) -> str:
    """An amount of the smallest unit, in whole tokens with a readable number of decimals."""
    whole, part = divmod(count, 10**coin.decimals)
    digits = f"{part:0{coin.decimals}}"[:DIGITS].rstrip("0") if coin.decimals else ""
    return f"{whole:,}{'.' if digits else ''}{digits} {coin.symbol}"


def at_least(count: int, coin: Currency) -> str:
    """The same, rounded up, so that the shown amount suffices."""
    last = 10 ** max(0, coin.decimals - DIGITS)
    return _amount(-(-count // last) * last, coin)


def _is_read_by_others(path: Path) -> bool:
    if os.name != "posix" or any(map(path.is_relative_to, SECRETS)):
        return False
    return bool(path.stat().st_mode & READ_BY_OTHERS)
