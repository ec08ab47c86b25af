"""The public chains by name: what a role must know of each, so that nobody has to look it up.

`chain = "base"` in the settings gives every option of `FILLED` that is not given the chain's value, and a node of
another chain is refused. What the node itself says (symbols, decimals, prices, the pace of blocks) is always asked of
the node; this table is what no node tells. `aira doctor` compares both.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, Literal

if TYPE_CHECKING:
    from collections.abc import Mapping

ORDER_SECONDS: Final = 600
"""Seconds for which an order is valid by default, also of what programs order of a signer."""
LONGEST_ORDER: Final = 86_400
"""Seconds after which an order ends at the latest."""
ETHEREUM_SECONDS: Final = 12.0
"""Between two blocks of Ethereum, which the contracts of some other chains count."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ChainProfile:
    """What is known of a chain; by default what holds where none is named."""

    name: str = ""
    """As in the setting `chain`."""
    title: str = "any chain"
    """For people."""
    chain_id: int = 0
    """EIP-155; 0 for any."""
    block_seconds: float = ETHEREUM_SECONDS
    """Between two blocks."""
    confirmations: int = 1
    reorg_depth: int = 12
    """Blocks behind the head that are remembered; public chains reorganise one or two."""
    poll_interval: float = 1.0
    log_range: int = 2000
    """Blocks whose logs are asked for at once, at first; less where a node refuses."""
    explorer: str = ""
    """The address of a block explorer; pages are at `/tx/…` and `/address/…`."""
    coin: str = "ETH"
    """What gas is paid in."""
    tokens: Mapping[str, str] = field(default_factory=dict)
    """Well-known tokens: addresses (EIP-55) by symbol."""
    has_priority_fee: bool = True
    """Whether a priority fee is paid beside the base fee."""
    l1: Literal["", "op", "arbitrum"] = ""
    """How an underlying chain shows: as a fee for data that an oracle tells (op), or as the numbers of blocks that
    contracts see (arbitrum)."""
    finalized: str = "whatever the node answers"
    """What final means there, in one sentence."""

    @property
    def deadline_limit(self) -> int:
        """The blocks of a day, as contracts count them."""
        return self.blocks_in(LONGEST_ORDER)

    def blocks_in(self, seconds: float) -> int:
        """How many blocks, as contracts count them, take so long."""
        return max(1, round(seconds / (ETHEREUM_SECONDS if self.l1 == "arbitrum" else self.block_seconds)))


FILLED: Final = ("confirmations", "reorg_depth", "poll_interval", "deadline_limit")
"""The options that are the profile's where they are not given, by the names that they have in both."""

ROLLED_UP: Final = (
    "latest is the sequencer's promise, safe is when the block's data is on Ethereum (minutes), finalized is when"
    " Ethereum has finalized that data (about 15 to 30 minutes)"
)

CHAINS: Final[Mapping[str, ChainProfile]] = MappingProxyType(
    {
        profile.name: profile
        for profile in (
            ChainProfile(
                name="base",
                title="Base",
                chain_id=8453,
                block_seconds=0.2,  # whole blocks, since the upgrade Denim of 2026-11-05; before, one each 2 s
                confirmations=5,
                reorg_depth=300,
                poll_interval=2.0,
                log_range=10_000,
                explorer="https://basescan.org",
                tokens={"USDC": "0x833589fCD6eDb6E08f4c7C32D4f71b54bdA02913"},
                l1="op",
                finalized=ROLLED_UP,
            ),
            ChainProfile(
                name="optimism",
                title="OP Mainnet",
                chain_id=10,
                block_seconds=2.0,
                confirmations=2,
                reorg_depth=30,
                explorer="https://optimistic.etherscan.io",
                tokens={"USDC": "0x0b2C639c533813f4Aa9D7837CAf62653d097Ff85"},
                l1="op",
                finalized=ROLLED_UP,
            ),
            ChainProfile(
                name="arbitrum",
                title="Arbitrum One",
                chain_id=42_161,
                block_seconds=0.25,
                confirmations=4,
                reorg_depth=240,
                poll_interval=2.0,
                log_range=10_000,
                explorer="https://arbiscan.io",
                tokens={"USDC": "0xaf88d065e77c8cC2239327C5EDb3A432268e5831"},
                has_priority_fee=False,
                l1="arbitrum",
                finalized=ROLLED_UP,
            ),
            ChainProfile(
                name="gnosis",
                title="Gnosis Chain",
                chain_id=100,
                block_seconds=5.0,
                confirmations=3,
                reorg_depth=48,
                explorer="https://gnosisscan.io",
                coin="xDAI",
                tokens={"USDC.e": "0x2a22f9c3b484c3629090FeED35F17Ff8F88f76F0"},
                finalized="two thirds of the stake have voted for the block twice, about 3 minutes after it",
            ),
            ChainProfile(
                name="polygon",
                title="Polygon PoS",
                chain_id=137,
                block_seconds=2.0,
                confirmations=4,
                reorg_depth=64,
                explorer="https://polygonscan.com",
                coin="POL",
                tokens={"USDC": "0x3c499c542cEF5E3811e1192ce70d8cC03d5c3359"},
                finalized="two thirds of the validators have agreed on the block in a milestone, some seconds after it",
            ),
            ChainProfile(
                name="ethereum",
                title="Ethereum",
                chain_id=1,
                confirmations=3,
                reorg_depth=64,
                explorer="https://etherscan.io",
                tokens={"USDC": "0xA0b86991c6218b36c1d19D4a2e9Eb0cE3606eB48"},
                finalized="two thirds of the stake have voted for the block twice, about 13 minutes after it",
            ),
            ChainProfile(
                name="sepolia",
                title="Sepolia, a test network",
                chain_id=11_155_111,
                confirmations=2,
                reorg_depth=64,
                explorer="https://sepolia.etherscan.io",
                tokens={"USDC": "0x1c7D4B196Cb0C7B01d743Fbc6116a902379C7238"},
                finalized="as on Ethereum, about 13 minutes after the block; its coins are worth nothing",
            ),
            ChainProfile(
                name="local",
                title="a development chain",
                block_seconds=1.0,
                finalized="whatever the node answers: on most of them each block is final at once",
            ),
        )
    }
)
"""The profiles by name."""


ANY: Final = ChainProfile()
"""What holds where no chain is named: blocks as slow as those of Ethereum, and nothing is waited for."""


def profile_of(chain_id: int) -> ChainProfile | None:
    """The profile of a chain by its number (EIP-155), if it is known."""
    return next((one for one in CHAINS.values() if one.chain_id == chain_id != 0), None)
