"""The peers of a channel and their statuses, also false ones of strangers."""

from __future__ import annotations

import asyncio
from contextlib import ExitStack, asynccontextmanager, contextmanager
from typing import TYPE_CHECKING

import pytest

from mesh.network import Channel, Endpoints, Network, Services
from mesh.watching import PresentPeer, present, status_of, statuses
from schemas import RpcKey
from schemas.status import ALIVE, BridgeStatus, DirectionStatus, Status, bridge_status_key
from tests.support.orders import MARKET, PERSON, ROBOT, STRANGER
from tests.support.waiting import until_answered, until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    import zenoh

    from schemas.rpc import Nothing
    from tests.support.routers import EmbeddedRouter

QUICK = 0.5
PATIENT = 60.0
WAY = DirectionStatus(
    received=0,
    invalid={},
    known=0,
    accepted=0,
    carried=0,
    left=0,
    dropped={},
    waiting=0,
    left_waiting=0,
    unheard=0,
    per_second=0.0,
)


def status(*, address: str = ROBOT.address, lighthouse: str = MARKET, role: str = "agent") -> Status:
    return Status(
        role=role,
        address=address,
        version="1",
        zenoh_id="ab",
        lighthouse=lighthouse,
        parts={"listener": ALIVE},
        head=7,
        chain_id=1,
    )


def bridge_status(*, bridge: str = STRANGER.address) -> BridgeStatus:
    return BridgeStatus(
        bridge=bridge,
        lighthouse=MARKET,
        state="alone",
        carries=True,
        api="http://127.0.0.1:5001",
        daemon="",
        dialect="",
        ipfs_peers=(),
        mesh_peers=(),
        losses=0,
        last_error="",
        to_ipfs=WAY,
        to_mesh=WAY,
    )


@contextmanager
def answering(session: zenoh.Session, key: str, payload: bytes) -> Iterator[None]:
    """Answer every query on the key with this payload."""

    def answer(query: zenoh.Query) -> None:
        query.reply(key, payload)

    with session.declare_queryable(key, answer):
        yield


class Meeting:
    """A channel with a reader, on which peers announce themselves."""

    def __init__(self, seen: Channel, reader: Network, shown: Channel, writer: Network) -> None:
        self.seen = seen
        self.session = reader.session
        self.shown = shown
        self.writer = writer

    async def see(self, *peers: PresentPeer) -> None:
        async def all_there() -> bool:
            return set(await present(self.seen)) == set(peers)

        await until_found(all_there, what=f"{peers}", seconds=30)

    @asynccontextmanager
    async def answering_with(self, *answers: Status) -> AsyncIterator[None]:
        """Meanwhile the service `status` of the address answers each of these."""
        async with Services(self.writer.session, answers[0].address) as services:
            for one in answers:

                async def answer(_request: Nothing, one: Status = one) -> Status:
                    return one

                services.offer("status", answer)
            await until_answered(self.session, str(RpcKey(answers[0].address, "status")))
            yield


@pytest.fixture
async def meeting(router: EmbeddedRouter) -> AsyncIterator[Meeting]:
    endpoints = Endpoints(connect=(router.endpoint,))
    async with (
        Network(endpoints) as writer,
        Channel(writer.session, MARKET) as shown,
        Network(endpoints) as reader,
        Channel(reader.session, MARKET) as seen,
    ):
        yield Meeting(seen, reader, shown, writer)


async def test_announced_agents_are_listed_by_role_and_address(meeting: Meeting) -> None:
    assert await present(meeting.seen) == []
    meeting.shown.announce("provider", PERSON.address)
    meeting.shown.announce("agent", ROBOT.address)
    await meeting.see(PresentPeer("agent", ROBOT.address), PresentPeer("provider", PERSON.address))
    found = await present(meeting.seen)
    assert found == sorted(found)


async def test_the_turn_token_of_a_bridge_is_no_peer(meeting: Meeting) -> None:
    meeting.shown.announce("bridge-turn-0-00000000000000ff", STRANGER.address)
    meeting.shown.announce("bridge", STRANGER.address)
    await meeting.see(PresentPeer("bridge", STRANGER.address))


async def test_an_address_reports_the_status_of_each_role(meeting: Meeting) -> None:
    both = status(), status(lighthouse="other.lighthouse.3.robonomics.eth", role="provider")
    async with meeting.answering_with(*both):

        async def all_answered() -> bool:
            return len(await status_of(meeting.session, ROBOT.address, MARKET)) == len(both)

        await until_found(all_answered, what="both answers", seconds=30)
        found = await status_of(meeting.session, ROBOT.address.lower(), MARKET, timeout=PATIENT)
        assert sorted(found, key=str) == sorted(both, key=str)


async def test_a_bridge_reports_its_status(meeting: Meeting) -> None:
    key = bridge_status_key(STRANGER.address, MARKET)
    with answering(meeting.writer.session, key, bridge_status().encode()):
        await until_answered(meeting.session, key)
        assert await status_of(meeting.session, STRANGER.address, MARKET, timeout=PATIENT) == [bridge_status()]
        peer = PresentPeer("bridge", STRANGER.address)
        assert await statuses(meeting.session, meeting.seen, [peer], timeout=PATIENT) == {peer: bridge_status()}


async def test_no_reply_is_no_status(meeting: Meeting) -> None:
    assert await status_of(meeting.session, STRANGER.address, MARKET) == []
    silent = asyncio.Event()

    async def never(_request: Nothing) -> Status:
        await silent.wait()
        return status()

    async with Services(meeting.writer.session, ROBOT.address) as services:
        services.offer("status", never)
        await until_answered(meeting.session, str(RpcKey(ROBOT.address, "status")))
        assert await status_of(meeting.session, ROBOT.address, MARKET, timeout=QUICK) == []


async def test_statuses_of_other_addresses_and_lighthouses_are_ignored(meeting: Meeting) -> None:
    peer = PresentPeer("agent", ROBOT.address)
    key = str(RpcKey(ROBOT.address, "status"))
    lies = (status(address=STRANGER.address).encode(), b"\xff", b"{}", status(lighthouse="another.eth").encode())
    with ExitStack() as stack:
        for lie in lies:
            stack.enter_context(answering(meeting.writer.session, key, lie))
        await until_answered(meeting.session, key)
        assert await statuses(meeting.session, meeting.seen, [peer]) == {peer: None}
        found = await status_of(meeting.session, ROBOT.address, MARKET)
        assert {one.lighthouse for one in found} <= {"another.eth"}


def test_unknown_fields_of_newer_versions_are_ignored() -> None:
    newer = status().encode()[:-1] + b',"mood":"fine"}'
    assert Status.decode(newer) == status()
