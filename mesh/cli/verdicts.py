"""What `aira liability` says of a validator's verdict: its jurors' reports, asked from the mesh."""

from __future__ import annotations

import asyncio
import json
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import click

from mesh.cli.output import plural, print_line, printable, short_address
from mesh.errors import AiraError
from schemas.address import ZERO_ADDRESS

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence

    from mesh.chain import Chain
    from mesh.network import Network
    from mesh.settings import Settings
    from schemas import Liability
    from schemas.verdicts import ValidatorReport

CONNECT_TIMEOUT: Final = 3.0
"""Seconds to connect to a router."""
INTERVAL: Final = 5.0
"""Seconds between two questions for new reports."""


async def reports_on(settings: Settings, chain: Chain, liability: Liability) -> Sequence[ValidatorReport] | None:
    """The verified reports of the jurors that answer; None if the mesh can't be asked, which is printed to stderr."""
    if liability.validator == ZERO_ADDRESS:
        return ()
    try:
        async with _network(settings) as network:
            return await _ask(network, settings, chain, liability)
    except AiraError as error:
        click.echo(f"aira: the validator's reports are not known: {error}", err=True)
        return None


def verdict_facts(reports: Sequence[ValidatorReport]) -> dict[str, str | None]:
    """Each juror's verdict, for people."""
    from mesh.agent.judged_contract import verdict_words

    return {f"juror {short_address(one.juror)}": printable(verdict_words(one)) for one in reports}


def reports_json(reports: Sequence[ValidatorReport] | None) -> list[Any] | None:
    """Reports for JSON: as they are on the wire."""
    return None if reports is None else [json.loads(one.encode()) for one in reports]


async def print_verdicts(settings: Settings, chain: Chain, liability: Liability) -> None:
    """Print each juror's verdict on an open liability when it is there, until cancelled."""
    from mesh.agent.judged_contract import verdict_words

    if liability.validator == ZERO_ADDRESS:
        return
    said: set[str] = set()
    try:
        jury = await chain.validators.jury(liability.validator)
        needed = plural(1 if jury is None else jury.quorum, "juror")
        print_line(f"its validator {liability.validator} must judge the result: {needed} alike")
        async with _network(settings) as network:
            while True:
                for one in await _ask(network, settings, chain, liability):
                    if one.juror not in said:
                        said.add(one.juror)
                        print_line(f"juror {one.juror} judged: {printable(verdict_words(one))}")
                await asyncio.sleep(INTERVAL)
    except AiraError as error:
        click.echo(f"aira: the validator's reports are not known: {error}", err=True)


@asynccontextmanager
async def _network(settings: Settings) -> AsyncIterator[Network]:
    from mesh.composition import endpoints_of
    from mesh.network import Network

    quick = replace(settings, connect_timeout=min(settings.connect_timeout, CONNECT_TIMEOUT))
    async with Network(endpoints_of(quick)) as network:
        yield network


async def _ask(network: Network, settings: Settings, chain: Chain, liability: Liability) -> Sequence[ValidatorReport]:
    from mesh.agent.reports import asked_reports

    lighthouse, timeout = settings.lighthouse_contract.lower(), settings.answer_timeout
    return await asked_reports(network.session, lighthouse, chain, liability, timeout=timeout)
