"""The relay's decisions, without a network."""

from __future__ import annotations

from itertools import count
from typing import TYPE_CHECKING, Any

import pytest

from bridges.ipfs._relay import (
    RELAY_LIMITS,
    MessageRelay,
    RelayJournal,
    RelayMessage,
    SeenMessages,
    Side,
    rank_for,
    rank_of,
)
from schemas import PresenceKey

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from bridges.ipfs._relay import Rank

ONE, TWO = f"0x{'1' * 40}", f"0x{'2' * 40}"
SENIOR, JUNIOR = rank_for(isolated=False, since_ns=1, bridge=ONE), rank_for(isolated=False, since_ns=2, bridge=TWO)
ISOLATED = rank_for(isolated=True, since_ns=1, bridge=ONE)
LIGHTHOUSE = "airalab.lighthouse.3.robonomics.eth"
_numbers = count()


class Time:
    now = 1000.0

    def __call__(self) -> float:
        return self.now


def waiting(journal: RelayJournal) -> set[bytes]:
    return {message.fingerprint for _, message in journal.waiting()}


def relayed(journal: RelayJournal) -> list[bytes]:
    return [fingerprint for fingerprint, _ in journal.relayed()]


@pytest.fixture
def time() -> Time:
    return Time()


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[RelayJournal]:
    with RelayJournal(tmp_path / "journal") as journal:
        yield journal


def bridge(time: Time, journal: RelayJournal, own: Rank | None = None, *others: Rank, **options: Any) -> MessageRelay:
    relay = MessageRelay(time, journal, **options)
    relay.own = own
    relay.others.update(others)
    return relay


def message() -> RelayMessage:
    return RelayMessage(next(_numbers).to_bytes(16, "big"), "aira/market/demand/model", b"payload", b"legacy", "")


def send_all(relay: MessageRelay, side: Side, *, heard: bool = True) -> list[bytes]:
    """Send everything that this bridge should send."""
    sent = []
    while (queued := relay.next(side)) is not None:
        relay.sent(queued, side, heard=heard)
        sent.append(queued.message.fingerprint)
    return sent


@pytest.mark.parametrize("side", Side)
def test_a_message_is_relayed_once_and_its_echo_is_not_sent_back(time: Time, journal: RelayJournal, side: Side) -> None:
    relay, one = bridge(time, journal, SENIOR), message()
    assert relay.receive(one, side)
    assert not relay.receive(one, side)
    assert waiting(journal) == {one.fingerprint}
    assert send_all(relay, side.other) == [one.fingerprint]
    assert not relay.receive(one, side.other)
    assert not relay.receive(one, side)
    assert (waiting(journal), relayed(journal)) == (set(), [one.fingerprint])
    assert send_all(relay, side) == send_all(relay, side.other) == []


def test_an_echo_before_the_daemons_answer_does_not_send_it_again(time: Time, journal: RelayJournal) -> None:
    relay, one = bridge(time, journal, SENIOR), message()
    relay.receive(one, Side.MESH)
    assert relay.next(Side.IPFS) is not None
    assert not relay.receive(one, Side.IPFS, echo=True)
    assert send_all(relay, Side.IPFS) == []
    assert relay.status(Side.IPFS, per_second=0).left == 0, "no other bridge sent it"


@pytest.mark.parametrize("by_this_bridge", [True, False])
def test_a_message_that_its_sender_repeats_is_relayed_again_and_its_echo_is_not(
    time: Time, journal: RelayJournal, by_this_bridge: bool
) -> None:
    relay, one = bridge(time, journal, SENIOR if by_this_bridge else JUNIOR), message()
    if not by_this_bridge:
        relay.others.add(SENIOR)
    relayed_at = []
    for _ in range(1500):
        relay.receive(one, Side.MESH)
        if relay.status(Side.IPFS, per_second=0).left_waiting:
            relay.receive(one, Side.IPFS)
            relayed_at.append(time.now)
        elif send_all(relay, Side.IPFS):
            relayed_at.append(time.now)
        assert not relay.receive(one, Side.IPFS)
        assert waiting(journal) == set()
        time.now += 1
    assert relayed_at == [1000, 1060, 1180, 1420, 1900]


def test_a_message_whose_sender_repeats_it_is_relayed_again_after_the_window(time: Time, journal: RelayJournal) -> None:
    relay, one = bridge(time, journal, SENIOR), message()
    relay.receive(one, Side.IPFS)
    relay.receive(one, Side.MESH)  # known on both sides without having been relayed
    time.now += RELAY_LIMITS.window - 1
    assert not relay.receive(one, Side.MESH)
    time.now += 2
    assert relay.receive(one, Side.MESH)


def test_unheard_messages_survive_a_restart(time: Time, journal: RelayJournal) -> None:
    relay, one, two, three = bridge(time, journal, ISOLATED, limit=2), message(), message(), message()
    for each in (one, two, three):
        relay.receive(each, Side.MESH)
        send_all(relay, Side.IPFS, heard=False)
    assert relay.status(Side.IPFS, per_second=0).dropped == {"unheard": 1}
    relay.receive(two, Side.IPFS)  # from another node
    assert waiting(journal) == {three.fingerprint}
    restarted = bridge(time, journal, SENIOR)
    restarted.restore()
    assert send_all(restarted, Side.IPFS) == [three.fingerprint]
    assert waiting(journal) == set()


def test_messages_of_another_bridge_are_not_sent_back(time: Time, journal: RelayJournal) -> None:
    relay, one = bridge(time, journal, SENIOR), message()
    assert not relay.receive(one, Side.MESH, by_bridge=True)
    assert send_all(relay, Side.IPFS) == []
    # The same message from its own sender is relayed.
    assert relay.receive(one, Side.MESH)


def test_the_longest_running_bridge_is_active_and_the_other_sees_messages_arrive(
    time: Time, journal: RelayJournal
) -> None:
    first, second = bridge(time, journal, SENIOR, JUNIOR), bridge(time, journal, JUNIOR, SENIOR)
    one = message()
    for relay in (first, second):
        relay.receive(one, Side.MESH)
    assert send_all(second, Side.IPFS) == []
    assert send_all(first, Side.IPFS) == [one.fingerprint]
    second.receive(one, Side.IPFS)
    second.others.discard(SENIOR)
    assert send_all(second, Side.IPFS) == []
    assert second.status(Side.IPFS, per_second=0).left == 1


def test_messages_left_to_a_bridge_that_stops_are_sent_by_the_next(time: Time, journal: RelayJournal) -> None:
    relay, one = bridge(time, journal, JUNIOR, SENIOR), message()
    relay.receive(one, Side.MESH)
    relay.others.discard(SENIOR)
    assert send_all(relay, Side.IPFS) == [one.fingerprint]


def test_what_the_active_bridge_has_not_sent_for_long_is_given_up(time: Time, journal: RelayJournal) -> None:
    relay, one, two = bridge(time, journal, JUNIOR, SENIOR), message(), message()
    relay.receive(one, Side.MESH)
    time.now += RELAY_LIMITS.window - 1
    relay.receive(two, Side.MESH)
    relay.expire()
    assert relay.status(Side.IPFS, per_second=0).left_waiting == 2
    time.now += 2
    relay.expire()
    assert waiting(journal) == {two.fingerprint}
    relay.others.discard(SENIOR)
    assert send_all(relay, Side.IPFS) == [two.fingerprint]


def test_a_bridge_without_its_daemon_holds_what_waits_until_another_has_sent_it(
    time: Time, journal: RelayJournal
) -> None:
    relay, one = bridge(time, journal, SENIOR), message()
    relay.receive(one, Side.MESH)
    relay.others.add(JUNIOR)
    relay.own = None
    assert not relay.is_active
    assert send_all(relay, Side.IPFS) == []
    relay.own = rank_for(isolated=False, since_ns=3, bridge=ONE)
    assert not relay.is_active
    relay.receive(one, Side.IPFS)
    assert waiting(journal) == set()


def test_a_bridge_without_peers_ranks_behind_one_with_peers(time: Time, journal: RelayJournal) -> None:
    isolated, connected = ISOLATED, JUNIOR
    assert not bridge(time, journal, isolated, connected).is_active
    assert bridge(time, journal, connected, isolated).is_active
    assert not bridge(time, journal, None, isolated).is_active
    assert bridge(time, journal, isolated).is_active
    relay, one = bridge(time, journal, isolated, connected), message()
    relay.receive(one, Side.MESH)
    assert send_all(relay, Side.IPFS) == []


def test_unheard_messages_are_sent_again_first_unless_another_node_sent_them(time: Time, journal: RelayJournal) -> None:
    relay, one, two, three = bridge(time, journal, ISOLATED), message(), message(), message()
    for each in (one, two):
        relay.receive(each, Side.MESH)
    send_all(relay, Side.IPFS, heard=False)
    relay.receive(one, Side.IPFS, echo=True)  # echo of our own daemon
    relay.receive(two, Side.IPFS)  # from another node
    relay.receive(three, Side.MESH)
    assert relay.status(Side.IPFS, per_second=0).unheard == 1
    relay.requeue_unheard()
    assert send_all(relay, Side.IPFS) == [one.fingerprint, three.fingerprint]


def test_a_full_queue_rejects_messages_and_loses_none(time: Time, journal: RelayJournal) -> None:
    relay, messages = bridge(time, journal, SENIOR, limit=2), [message() for _ in range(3)]
    assert [relay.receive(one, Side.MESH) for one in messages] == [True, True, False]
    assert relay.status(Side.IPFS, per_second=0).dropped == {"no-room": 1}
    assert send_all(relay, Side.IPFS) == [one.fingerprint for one in messages[:2]]
    assert relay.receive(messages[2], Side.MESH)


def test_a_flood_of_orders_delays_no_result_and_takes_no_room_from_it(time: Time, journal: RelayJournal) -> None:
    relay, orders = bridge(time, journal, SENIOR, limit=4), [message() for _ in range(9)]
    results = [message()._replace(key="aira/market/result") for _ in range(2)]
    for order in orders:
        relay.receive(order, Side.MESH)
    for result in results:
        assert relay.receive(result, Side.MESH)
    first, second = (result.fingerprint for result in results)
    queued = [order.fingerprint for order in orders[:4]]
    assert send_all(relay, Side.IPFS) == [first, queued[0], second, *queued[1:]]


def test_a_refused_message_is_dropped_and_counted(time: Time, journal: RelayJournal) -> None:
    relay, one = bridge(time, journal, SENIOR), message()
    relay.receive(one, Side.MESH)
    queued = relay.next(Side.IPFS)
    assert queued is not None
    relay.refused(queued, Side.IPFS)
    assert relay.status(Side.IPFS, per_second=0).dropped == {"refused": 1}
    assert waiting(journal) == set()


def test_a_restored_bridge_holds_what_waited_while_another_is_active(time: Time, journal: RelayJournal) -> None:
    one = message()
    journal.add_waiting(Side.IPFS, one)
    relay = bridge(time, journal, JUNIOR, SENIOR)
    relay.restore()
    assert send_all(relay, Side.IPFS) == []
    relay.others.discard(SENIOR)
    assert send_all(relay, Side.IPFS) == [one.fingerprint]


def test_the_deduplication_memory_is_bounded(time: Time) -> None:
    seen = SeenMessages(time)
    for number in range(RELAY_LIMITS.remembered + 1):
        seen.add(number.to_bytes(16, "big"), Side.MESH)
    assert len(seen) == RELAY_LIMITS.remembered
    assert not seen.contains((0).to_bytes(16, "big"), Side.MESH)
    relayed = SeenMessages(time)
    for number in range(RELAY_LIMITS.remembered + 1):
        relayed.add_relayed(number.to_bytes(16, "big"), Side.MESH)
    assert len(relayed) == RELAY_LIMITS.remembered


@pytest.mark.parametrize("rank", [SENIOR, ISOLATED])
def test_a_rank_is_read_as_it_was_announced(rank: Rank) -> None:
    assert rank_of(PresenceKey(LIGHTHOUSE, *rank)) == rank


@pytest.mark.parametrize("role", ["bridge", "provider"])
def test_other_tokens_are_not_ranks(role: str) -> None:
    assert rank_of(PresenceKey(LIGHTHOUSE, role, ONE)) is None
