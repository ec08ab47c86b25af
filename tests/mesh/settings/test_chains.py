"""The table of chains: addresses with a valid checksum, numbers that fit each other."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from mesh.settings.chains import CHAINS, ChainProfile, profile_of
from schemas.address import parse_address
from tests.support.content import ROOT

if TYPE_CHECKING:
    from collections.abc import Mapping


def test_the_chains_are_known_by_name_and_by_number() -> None:
    assert list(CHAINS) == ["base", "optimism", "arbitrum", "gnosis", "polygon", "ethereum", "sepolia", "local"]
    assert {name: profile.chain_id for name, profile in CHAINS.items()} == {
        "base": 8453,
        "optimism": 10,
        "arbitrum": 42_161,
        "gnosis": 100,
        "polygon": 137,
        "ethereum": 1,
        "sepolia": 11_155_111,
        "local": 0,
    }
    assert profile_of(8453) is CHAINS["base"]
    assert profile_of(31_337) is None


@pytest.mark.parametrize("profile", CHAINS.values(), ids=CHAINS)
def test_each_profile_fits_itself(profile: ChainProfile) -> None:
    addresses: Mapping[str, str] = profile.tokens
    assert all(parse_address(address) == address for address in addresses.values())
    assert profile.confirmations <= profile.reorg_depth
    assert profile.explorer.startswith("https://") is (profile.name != "local")
    assert not profile.explorer.endswith("/")
    assert len(profile.finalized.split(". ")) == 1, "one sentence"


def test_times_are_counted_in_the_blocks_that_contracts_see() -> None:
    assert CHAINS["ethereum"].deadline_limit == 7200
    assert CHAINS["base"].deadline_limit == 432_000
    assert CHAINS["arbitrum"].deadline_limit == 7200, "contracts see the blocks of Ethereum there"
    assert CHAINS["base"].blocks_in(0.01) == 1


def test_the_page_has_the_table() -> None:
    page = (ROOT / "docs" / "reference" / "chains.md").read_text()
    table = page.partition("| `chain` | network |")[2].partition("\n\n")[0]
    rows = [
        tuple(cell.strip() for cell in line.strip("|").split("|")) for line in table.splitlines() if line[:3] == "| `"
    ]
    assert rows == [
        (
            f"`{one.name}`",
            one.title,
            str(one.chain_id or "any"),
            f"{one.block_seconds:g} s",
            str(one.confirmations),
            str(one.reorg_depth),
            f"{one.deadline_limit:,}",
            one.coin,
            ", ".join(f"{symbol} `{address}`" for symbol, address in one.tokens.items()) or "none",
            one.explorer or "none",
        )
        for one in CHAINS.values()
    ]
    assert [f"- {one.title}: {one.finalized}." in page for one in CHAINS.values()] == [True] * len(CHAINS)
