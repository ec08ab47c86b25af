"""How somebody in the mesh is, in words. All of it is what that one says, so it must not steer the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from mesh.cli.amounts import ETH, XRT
from mesh.cli.files import duration_words, size_words
from mesh.cli.printing import plural, visible
from schemas import parse_address
from schemas.status import ALIVE, OFF, BridgeStatus, Status

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.watching import How
    from schemas.status import ContentMetrics, DirectionStatus, MarketStatus, Work

PHASES: Final = ("incoming", "ready", "running", "complete")
"""Of jobs that are not at their end."""


def spoken(how: How) -> dict[str, str]:
    """All that somebody says of itself, by what it is about."""
    told = _bridge(how) if isinstance(how, BridgeStatus) else _participant(how)
    return {visible(name): visible(fact) for name, fact in told.items()}


def in_short(how: How | None) -> str:
    """The same in a line; None is somebody who does not say it."""
    if how is None:
        return "does not answer"
    if isinstance(how, BridgeStatus):
        carries = "carries" if how.carries else "stands by"
        words = [how.state, carries, f"{plural(len(how.ipfs_peers), 'node')} on the IPFS side"]
    else:
        troubles = [f"{part} {state}" for part, state in how.parts.items() if state not in (ALIVE, OFF)]
        words = [*(troubles or [ALIVE]), f"block {how.head:,}"]
        if how.work is not None:
            words.append(plural(_open_jobs(how.work), "open job"))
        if how.market is not None:
            words += [plural(how.market.open_orders, "open order"), plural(how.market.created, "contract")]
    return visible(", ".join(words))


def _participant(how: Status) -> dict[str, str]:
    facts: dict[str, str] = {
        how.role: how.address,
        "lighthouse": how.lighthouse,
        **how.parts,
        "block": f"{how.head:,} of chain {how.chain_id}",
    }
    facts |= {} if how.work is None else _work(how.work)
    facts |= {} if how.market is None else _market(how.market)
    return facts | {
        "runs for": duration_words(int(how.uptime) * 10**9),
        "version": how.version,
        "Zenoh id": how.zenoh_id,
    }


def _work(work: Work) -> dict[str, str]:
    open_jobs = ", ".join(f"{work.jobs[phase]:,} {phase}" for phase in PHASES if work.jobs.get(phase))
    store, quota = work.store, work.store.quota
    room = "" if quota is None else f" of {size_words(quota)}"
    return {
        "open jobs": open_jobs or "none",
        "done": f"{work.jobs.get('finalized', 0):,}",
        "to be sent": plural(work.outbox, "message"),
        "store": f"{plural(store.files, 'file')}, {size_words(store.bytes)}{room}",
    }


def _market(market: MarketStatus) -> dict[str, str]:
    return {
        "open orders": f"{market.open_orders:,}",
        "contracts": f"{market.created:,} made, {market.finalized:,} finalized",
        "rejected": _counts(market.rejected),
        "earned": f"{XRT.show(market.fees + market.minted)}, {XRT.show(market.fees)} of it fees",
        "spent": f"{ETH.show(market.spent)} on {market.gas_used:,} gas",
    }


def _bridge(how: BridgeStatus) -> dict[str, str]:
    return {
        "bridge": parse_address(how.bridge),
        "lighthouse": how.lighthouse,
        "state": how.state,
        "carries": "yes" if how.carries else "no, it stands by",
        "daemon": f"{how.daemon or 'not reached yet'} at {how.api}" + (f", {how.dialect}" if how.dialect else ""),
        "IPFS side": plural(len(how.ipfs_peers), "node"),
        "mesh side": plural(len(how.mesh_peers), "peer"),
        "to IPFS": _way(how.to_ipfs),
        "to mesh": _way(how.to_mesh),
        **({} if how.content is None else {"content": _content(how.content)}),
        "losses": f"{how.losses:,} of the daemon",
        "last error": how.last_error or "none",
        "runs for": duration_words(int(how.uptime) * 10**9),
    }


def _content(figures: ContentMetrics) -> str:
    brought = f"{plural(figures.fetched, 'file')} fetched ({size_words(figures.fetched_bytes)})"
    taken = f"{figures.added:,} added ({size_words(figures.added_bytes)})"
    return f"{brought}, {taken}, {plural(figures.answered, 'block')} given, {figures.lies:,} false ones refused"


def _way(way: DirectionStatus) -> str:
    refused = f", {_counts(way.invalid)} refused" if way.invalid else ""
    return (
        f"{way.carried:,} carried ({way.per_second:.1f}/s), {way.waiting:,} waiting, "
        f"{_counts(way.dropped)} dropped{refused}"
    )


def _counts(counts: Mapping[str, int]) -> str:
    """How many in all, and of which kind."""
    kinds = ", ".join(f"{count:,} {kind}" for kind, count in sorted(counts.items()))
    return f"{sum(counts.values()):,}" + (f" ({kinds})" if kinds else "")


def _open_jobs(work: Work) -> int:
    return sum(work.jobs.get(phase, 0) for phase in PHASES)
