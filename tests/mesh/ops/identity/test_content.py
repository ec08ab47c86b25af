"""Content on a site: members hold it under their own keys, and a lying member answers on no others."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING

import pytest
import zenoh

from mesh.base.flood import Drops
from mesh.content import Exchange, Store
from mesh.content._exchange import LIE
from mesh.ops.identity import Member
from schemas.unixfs import CHUNK_SIZE
from tests.support.content import requested_cid, sample_bytes
from tests.support.sites import Site
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from pathlib import Path

NAMES = ("robot", "person", "liar", "bystander")
ADDRESSES = {name: "0x" + f"{number:02x}" * 20 for number, name in enumerate(NAMES, 1)}
BLOCKS = 8


@pytest.mark.parametrize("kind", ["wheel", "zenohd"])
async def test_a_lying_member_can_not_answer_for_the_holder_of_a_file(tmp_path: Path, kind: str) -> None:
    site, data, drops = Site(tmp_path), sample_bytes(BLOCKS * CHUNK_SIZE), Drops()
    folders = {name: site.enlist(Member(name=name, address=ADDRESSES[name], roles=("agent",))) for name in NAMES}
    asked: list[str] = []

    def lie(query: zenoh.Query) -> None:
        asked.append(requested_cid(query))
        with query:
            for name in ("robot", "liar"):  # as the robot, and as itself
                for _ in range(40):
                    query.reply(str(query.key_expr).replace("*", ADDRESSES[name]), b"a lie")

    with ExitStack() as stack:
        stack.enter_context(site.open_router(kind))
        robot, person, liar, bystander = (
            stack.enter_context(zenoh.open(site.client(folders[name]).config())) for name in NAMES
        )
        for selector in ("aira/**", "aira/agent/*/cid/*", f"aira/agent/{ADDRESSES['liar']}/cid/*"):
            stack.enter_context(liar.declare_queryable(selector, lie))
        held = stack.enter_context(Store(tmp_path / "held"))
        store = stack.enter_context(Store(tmp_path / "fetched"))
        cid = held.put_bytes(data)
        async with (
            Exchange(robot, held, address=ADDRESSES["robot"]) as holder,
            Exchange(person, store, address=ADDRESSES["person"], drops=drops) as exchange,
        ):

            async def lied() -> bool:
                list(bystander.get(f"aira/agent/*/cid/{cid}", target=zenoh.QueryTarget.ALL, timeout=10.0))
                return bool(asked) and holder.statistics().served > 0

            await until_found(lied, what="the liar and the holder", seconds=30)
            asked.clear()

            assert (await exchange.fetch(cid, timeout=60)).read_bytes() == data

            # The root is requested from all, and so is a block for which Zenoh did not reach the holder on its own key.
            assert len(set(asked) - {cid}) < BLOCKS
    assert {name.partition("@")[0] for name, _ in drops.heaviest(LIE)} <= {ADDRESSES["liar"]}, "it lies as itself only"
    assert drops.totals()[LIE] >= 1
