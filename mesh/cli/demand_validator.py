"""What `aira demand --validator` and the page say before they sign: who judges, by which policies, for what fee."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from mesh.amounts import XRT
from mesh.cli.errors import DoubtfulValidator
from mesh.cli.output import plural, print_json, print_line, printable
from mesh.cli.waiting import answer_of
from mesh.errors import AiraError
from schemas.address import ZERO_ADDRESS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mesh import AnnouncedValidator
    from mesh.agent import Agent
    from mesh.agent.validators import ValidatorDirectory
    from mesh.chain import Chain


@dataclass(frozen=True, kw_only=True)
class JudgedTerms:
    """What a validator announces, the fee that the demand offers, and when the cost can be returned without it."""

    announced: AnnouncedValidator
    fee: int
    refund_delay: int | None
    """Blocks from the contract's creation; None if the contracts offer no refund."""
    block_time: float | None
    """Seconds."""

    @classmethod
    async def of(
        cls,
        chain: Chain,
        directory: ValidatorDirectory,
        validator: str,
        *,
        lighthouse: str,
        generation: int,
        fee: int | None,
    ) -> JudgedTerms:
        """Those of a demand at `lighthouse` that names `validator` (addresses); without a `fee` (wn) what it announces.

        Raises `UnsafeValidator` and its like, `ChainError`.
        """
        from mesh.agent.validators import check_named, refund_delay

        await check_named(chain, validator, lighthouse=lighthouse, generation=generation)
        announced = await directory.find(validator)
        return cls(
            announced=announced,
            fee=announced.fee if fee is None else fee,
            refund_delay=await refund_delay(chain),
            block_time=await _block_time(chain),
        )

    @property
    def doubts(self) -> dict[str, str]:
        """Why perhaps nobody will judge, by code."""
        announced, doubts = self.announced, {}
        if announced.is_silent:
            doubts["silent"] = "nobody answers as this validator on the mesh, so perhaps nobody will judge"
        elif not announced.has_quorum:
            missing = (
                f"only {len(announced.announcements)} of the {announced.quorum} jurors that must judge alike answer"
            )
            doubts["few-jurors"] = missing
        if self.fee < announced.fee:
            offered = f"the fee is {XRT.show(self.fee)}, but the validator wants {XRT.show(announced.fee)}"
            doubts["low-fee"] = f"{offered}, so it may refuse the work"
        return doubts

    @property
    def reasons(self) -> str:
        """The doubts, for people."""
        return "; ".join(self.doubts.values())

    def lines(self) -> Iterator[str]:
        """What it means, for people."""
        found = self.announced
        title = f"{printable(found.title)}, " if found.title else ""
        yield f"validator {title}{found.address}"
        if not found.is_silent:
            online = f"{len(found.announcements)} of its {found.jurors} jurors are on the mesh"
            judges = "it is on the mesh" if found.jurors == 1 else f"{online}, {found.quorum} must judge alike"
            yield f"  {judges}; nobody is paid for the work before it has judged"
            for policy in found.policies:
                yield f"  judges by {policy.name}: {printable(policy.description)}"
            if not found.is_unanimous:
                yield "  its jurors judge by different policies"
        low = " (what it wants is not known)" if found.is_silent else ""
        yield f"  fee {XRT.show(self.fee)}{low}, on top of the cost, also if the work does not count"
        yield f"  if it is silent: {self.refund}"

    @property
    def refund(self) -> str:
        """What can be returned, and when, if nobody judges."""
        if self.refund_delay is None:
            return "the contracts offer no refund, so the cost stays in the contract"
        about = f" (about {_rough(self.refund_delay * self.block_time)})" if self.block_time else ""
        return (
            f"cost and fee can be refunded {plural(self.refund_delay, 'block')}{about} after the contract was created"
        )

    def json(self) -> dict[str, Any]:
        """The same for JSON; fees in wn."""
        found = self.announced
        return {
            "validator": found.address,
            "title": found.title,
            "jurors": found.jurors,
            "quorum": found.quorum,
            "online": [one.juror for one in found.announcements],
            "policies": [{"name": policy.name, "description": policy.description} for policy in found.policies],
            "unanimous": found.is_unanimous,
            "announcedFee": None if found.is_silent else str(found.fee),
            "fee": str(self.fee),
            "refundDelay": self.refund_delay,
            "blockTime": self.block_time,
            "doubts": self.doubts,
        }


def _rough(seconds: float) -> str:
    """A time for people, in minutes, hours or days."""
    for unit, length in (("day", 86_400), ("hour", 3600)):
        if seconds >= 2 * length:
            return plural(round(seconds / length), unit)
    return plural(max(round(seconds / 60), 1), "minute")


async def agreed_fee(
    agent: Agent, cid: str, fee: int | None, *, confirmed: bool, as_json: bool, validator: str, **fields: Any
) -> int:
    """The validator's fee for a demand of the objective `cid`, in wn, once its maker knows what the validator means.

    `fee` is what the maker offers, None for what is announced. Doubts whether somebody will judge must be `confirmed`,
    or are asked about in a terminal. Raises `UnsafeValidator` and its like, and `DoubtfulValidator`.
    """
    if not validator:
        return 0
    runtime = agent.runtime
    terms = await runtime.trader.writer.terms(model=agent.model, objective=cid, token="", validator=validator, **fields)
    if terms["validator"] == ZERO_ADDRESS:
        return 0
    judged = await JudgedTerms.of(
        agent.parts.chain,
        runtime.validators,
        terms["validator"],
        lighthouse=terms["lighthouse"],
        generation=agent.settings.generation,
        fee=fee,
    )
    if as_json:
        print_json({"kind": "validator"} | judged.json())
    else:
        for line in judged.lines():
            print_line(line)
    if judged.doubts:
        await _confirm(judged.reasons, confirmed=confirmed, quiet=as_json)
    return judged.fee


async def _confirm(reasons: str, *, confirmed: bool, quiet: bool) -> None:
    """Say the doubts, and ask in a terminal, unless they are confirmed. Raises `DoubtfulValidator`."""
    can_ask = sys.stdin.isatty() and not quiet
    if confirmed or can_ask:
        click.echo(f"aira: {reasons}", err=True)
    if not (confirmed or (can_ask and await answer_of(_ask))):
        raise DoubtfulValidator(f"not posted: {reasons}", hint="`--yes` posts the demand all the same")


async def _block_time(chain: Chain) -> float | None:
    """Seconds between the latest blocks; None if that is not known."""
    from mesh.agent.terms import MEASURED_BLOCKS

    try:
        return await chain.node.heads.block_time(MEASURED_BLOCKS)
    except AiraError:
        return None


def _ask() -> bool:
    return click.confirm("post the demand all the same?", err=True)
