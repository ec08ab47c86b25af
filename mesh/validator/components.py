"""The components of a validator, the order in which they are opened, and what it checks before that."""

from __future__ import annotations

import logging
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mesh.base.log_context import log_event
from mesh.chain import FeeTooHigh, InsufficientFunds, RequestRefused
from mesh.errors import ChainError
from mesh.role.composition import RoleParts, open_parts, opened_chain
from mesh.validator.ledger import VERDICTS, VerdictLedger

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence
    from pathlib import Path

    from mesh.base.flood import Drops
    from mesh.chain import Account, Chain
    from mesh.settings import Settings
    from mesh.validator.policies import Policy

log = logging.getLogger(__name__)

LOOKBACK: Final = 50_400
"""Blocks that a validator reads at most of those before its start: after so many, liabilities can be refunded."""


@dataclass(frozen=True, kw_only=True)
class Court:
    """As what a validator judges: its account (generation 3) and, if it has one, its contract (generation 5).

    A result needs the signatures of `quorum` of the contract's `jurors`.
    """

    account: str
    contract: str = ""
    quorum: int = 1
    jurors: int = 1

    @property
    def validators(self) -> tuple[str, ...]:
        """The addresses that liabilities may name, the contract first."""
        return (self.contract, self.account) if self.contract else (self.account,)


@dataclass(frozen=True, kw_only=True)
class ValidatorComponents(RoleParts[VerdictLedger]):
    """The open components of a validator, and how it judges, for what least `fee` (wn)."""

    policies: Sequence[Policy]
    fee: int
    title: str
    court: Court


@asynccontextmanager
async def judging(
    settings: Settings,
    account: Account,
    chain: Chain | None,
    *,
    policies: Sequence[Policy],
    fee: int,
    title: str,
    drops: Drops,
) -> AsyncIterator[ValidatorComponents]:
    """The components of a validator on `chain` (open), or on the chain that the settings name.

    Raises `ChainError`, and the errors of opening what it needs.
    """
    async with AsyncExitStack() as stack:
        chain = await opened_chain(stack, settings, account, chain)
        court = await court_of(chain, account.address, settings.validator_contract)
        if not court.contract:
            await _introduce(chain, account.address)

        def ledger(folder: Path) -> VerdictLedger:
            return VerdictLedger(folder / VERDICTS, account.signer)

        shared = await open_parts(stack, settings, account, chain, ledger=ledger, drops=drops, lookback=LOOKBACK)
        yield ValidatorComponents(**vars(shared), policies=policies, fee=fee, title=title, court=court)


async def court_of(chain: Chain, account: str, contract: str) -> Court:
    """As what the account may judge, with the contract (ENS name or address) that the settings name, if any.

    Raises `ChainError` if it may not judge there.
    """
    if not contract:
        if not await chain.tokens.eth_balance():
            why = "%s has no ETH: it can't finalize liabilities that name the account itself"
            log.warning(why, account, extra=log_event("validator-without-eth", account=account))
        return Court(account=account)
    address = await chain.names.address(contract)
    why = ""
    if await chain.lighthouses.exists(address):
        why = "is a lighthouse, not a validator contract"
    elif not await chain.node.code(address):
        why = "has no code: it is not a validator contract"
    if why:
        hint = "create one with `aira validator deploy`, then pass its address with --validator-contract"
        raise ChainError(f"{address} {why}", hint=hint, code="not-a-validator")
    if not await chain.validators.accepts(address, account):
        hint = "create a contract that names this account: `aira validator deploy`"
        why = f"{account} is no juror of the validator contract {address}"
        raise ChainError(why, hint=hint, code="not-a-juror")
    jury = await chain.validators.jury(address)
    if jury is None:  # another contract with `isValidator`, to which one signature is enough
        return Court(account=account, contract=address)
    return Court(account=account, contract=address, quorum=jury.quorum, jurors=len(jury.jurors))


async def _introduce(chain: Chain, account: str) -> None:
    """Make the account known: orders name only accounts that have sent a transaction."""
    try:
        await chain.validators.introduce()
    except (InsufficientFunds, FeeTooHigh, RequestRefused) as error:
        facts = log_event("validator-not-known", account=account)
        log.warning("%s has sent no transaction yet, so nobody can name it: %s", account, error, extra=facts)
