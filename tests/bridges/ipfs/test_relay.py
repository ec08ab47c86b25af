"""The relay's decisions, without a network."""

from __future__ import annotations

from itertools import count
from typing import TYPE_CHECKING, Any

import pytest

from bridges.ipfs.journal import (
    DEDUPLICATION_LIMIT,
    DEDUPLICATION_WINDOW,
    RelayedMessages,
    RelayJournal,
    SeenMessages,
    Side,
)
from bridges.ipfs.publish_queue import TAKEOVER_AFTER, QueuedMessage, Rank, active_bridge, rank_of
from bridges.ipfs.relay import MessageRelay, RelayOutcome
from bridges.ipfs.validation import RelayMessage
from schemas import PresenceKey

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

ONE, TWO = f"0x{'1' * 40}", f"0x{'2' * 40}"
SENIOR, JUNIOR = Rank(False, 1, ONE), Rank(False, 2, TWO)
LIGHTHOUSE = "airalab.lighthouse.3.robonomics.eth"
_numbers = count()


class Time:
    now = 1000.0

    def __call__(self) -> float:
        return self.now


def waiting(journal: RelayJournal) -> set[bytes]:
    return {queued.message.fingerprint for _, queued in journal.waiting()}


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
    for other in others:
        relay.bridge_joined(other)
    relay.set_rank(own)
    return relay


def message() -> RelayMessage:
    return RelayMessage(next(_numbers).to_bytes(16, "big"), "aira/market/demand/model", b"payload", b"legacy", "")


def send_all(relay: MessageRelay, side: Side, *, heard: bool = True) -> list[bytes]:
    """Send everything that this bridge should send."""
    sent = []
    while (queued := relay.queues[side].next()) is not None:
        relay.sent(queued, side, heard=heard)
        sent.append(queued.message.fingerprint)
    return sent


@pytest.mark.parametrize("side", Side)
def test_a_message_is_relayed_once_and_its_echo_is_not_sent_back(time: Time, journal: RelayJournal, side: Side) -> None:
    relay, one = bridge(time, journal, SENIOR), message()
    assert relay.receive(one, side) is RelayOutcome.ACCEPTED
    assert relay.receive(one, side) is RelayOutcome.KNOWN
    assert waiting(journal) == {one.fingerprint}
    assert send_all(relay, side.other) == [one.fingerprint]
    assert relay.receive(one, side.other) is RelayOutcome.KNOWN
    assert relay.receive(one, side) is RelayOutcome.KNOWN
    assert (waiting(journal), relayed(journal)) == (set(), [one.fingerprint])
    assert send_all(relay, side) == send_all(relay, side.other) == []


def test_an_echo_before_the_daemons_answer_does_not_send_it_again(time: Time, journal: RelayJournal) -> None:
    relay, one = bridge(time, journal, SENIOR), message()
    relay.receive(one, Side.MESH)
    assert relay.queues[Side.IPFS].next() is not None
    assert relay.receive(one, Side.IPFS, echo=True) is RelayOutcome.KNOWN
    assert send_all(relay, Side.IPFS) == []
    assert relay.status(Side.IPFS, per_second=0).left == 0, "no other bridge sent it"


@pytest.mark.parametrize("by_this_bridge", [True, False])
def test_a_message_that_its_sender_repeats_is_relayed_again_and_its_echo_is_not(
    time: Time, journal: RelayJournal, by_this_bridge: bool
) -> None:
    relay, one = bridge(time, journal, SENIOR if by_this_bridge else JUNIOR), message()
    if not by_this_bridge:
        relay.bridge_joined(SENIOR)
    relayed_at = []
    for _ in range(1500):
        relay.receive(one, Side.MESH)
        if relay.queues[Side.IPFS].left:
            relay.receive(one, Side.IPFS)
            relayed_at.append(time.now)
        elif send_all(relay, Side.IPFS):
            relayed_at.append(time.now)
        assert relay.receive(one, Side.IPFS) is RelayOutcome.KNOWN
        assert waiting(journal) == set()
        time.now += 1
    assert relayed_at == [1000, 1060, 1180, 1420, 1900]


def test_a_message_whose_sender_repeats_it_is_relayed_again_after_the_window(time: Time, journal: RelayJournal) -> None:
    relay, one = bridge(time, journal, SENIOR), message()
    relay.receive(one, Side.IPFS)
    relay.receive(one, Side.MESH)  # known on both sides without having been relayed
    time.now += DEDUPLICATION_WINDOW - 1
    assert relay.receive(one, Side.MESH) is RelayOutcome.KNOWN
    time.now += 2
    assert relay.receive(one, Side.MESH) is RelayOutcome.ACCEPTED


def test_unheard_messages_survive_a_restart(time: Time, journal: RelayJournal) -> None:
    relay, one, two, three = bridge(time, journal, Rank(True, 1, ONE), limit=2), message(), message(), message()
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
    assert relay.receive(one, Side.MESH, by_bridge=True) is RelayOutcome.KNOWN
    assert send_all(relay, Side.IPFS) == []
    # The same message from its own sender is relayed.
    assert relay.receive(one, Side.MESH) is RelayOutcome.ACCEPTED


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
    second.bridge_left(SENIOR)
    assert send_all(second, Side.IPFS) == []
    assert second.status(Side.IPFS, per_second=0).left == 1


def test_messages_left_to_a_bridge_that_stops_are_sent_by_the_next(time: Time, journal: RelayJournal) -> None:
    relay, one = bridge(time, journal, JUNIOR, SENIOR), message()
    relay.receive(one, Side.MESH)
    relay.bridge_left(SENIOR)
    assert send_all(relay, Side.IPFS) == [one.fingerprint]


def test_overdue_messages_are_taken_back(time: Time, journal: RelayJournal) -> None:
    relay, one, two, late = bridge(time, journal, JUNIOR, SENIOR), message(), message(), message()
    relay.receive(one, Side.MESH)
    relay.receive(two, Side.MESH)
    time.now += TAKEOVER_AFTER - 1
    relay.receive(two, Side.IPFS)  # the other bridge is sending
    time.now += 2
    assert relay.take_overdue() == 0
    time.now += TAKEOVER_AFTER - 3
    relay.receive(late, Side.MESH)
    time.now += 2
    assert relay.take_overdue() == 1
    assert send_all(relay, Side.IPFS) == [one.fingerprint]


def test_a_bridge_without_its_daemon_hands_over_what_the_other_holds_too(time: Time, journal: RelayJournal) -> None:
    relay = bridge(time, journal, SENIOR)
    alone, shared = message(), message()
    relay.receive(alone, Side.MESH)
    relay.bridge_joined(JUNIOR)
    relay.receive(shared, Side.MESH)
    relay.set_rank(None)
    relay.set_rank(Rank(False, 3, ONE))
    assert send_all(relay, Side.IPFS) == [alone.fingerprint]
    assert waiting(journal) == set()


def test_a_bridge_without_peers_ranks_behind_one_with_peers(time: Time, journal: RelayJournal) -> None:
    isolated, connected = Rank(True, 1, ONE), Rank(False, 2, TWO)
    assert active_bridge(isolated, [connected]) == connected
    assert active_bridge(connected, [isolated]) is None
    assert active_bridge(None, [isolated]) == isolated
    assert active_bridge(None, []) is None
    relay, one = bridge(time, journal, isolated, connected), message()
    relay.receive(one, Side.MESH)
    time.now += 2 * TAKEOVER_AFTER
    assert relay.take_overdue() == 0  # it can't see whether it arrived
    assert send_all(relay, Side.IPFS) == []


def test_unheard_messages_are_sent_again_first_unless_another_node_sent_them(time: Time, journal: RelayJournal) -> None:
    relay, one, two, three = bridge(time, journal, Rank(True, 1, ONE)), message(), message(), message()
    for each in (one, two):
        relay.receive(each, Side.MESH)
    send_all(relay, Side.IPFS, heard=False)
    relay.receive(one, Side.IPFS, echo=True)  # echo of our own daemon
    relay.receive(two, Side.IPFS)  # from another node
    relay.receive(three, Side.MESH)
    assert relay.queues[Side.IPFS].unheard == 1
    assert relay.queues[Side.IPFS].requeue_unheard() == 1
    assert send_all(relay, Side.IPFS) == [one.fingerprint, three.fingerprint]


def test_a_full_queue_rejects_messages_and_loses_none(time: Time, journal: RelayJournal) -> None:
    relay, messages = bridge(time, journal, SENIOR, limit=2), [message() for _ in range(3)]
    assert [relay.receive(one, Side.MESH) for one in messages] == [
        RelayOutcome.ACCEPTED,
        RelayOutcome.ACCEPTED,
        RelayOutcome.QUEUE_FULL,
    ]
    assert relay.status(Side.IPFS, per_second=0).dropped == {"no-room": 1}
    assert send_all(relay, Side.IPFS) == [one.fingerprint for one in messages[:2]]
    assert relay.receive(messages[2], Side.MESH) is RelayOutcome.ACCEPTED


def test_a_flood_of_orders_delays_no_result_and_takes_no_room_from_it(time: Time, journal: RelayJournal) -> None:
    relay, orders = bridge(time, journal, SENIOR, limit=4), [message() for _ in range(9)]
    results = [message()._replace(key="aira/market/result") for _ in range(2)]
    for order in orders:
        relay.receive(order, Side.MESH)
    outcomes = [relay.receive(result, Side.MESH) for result in results]
    assert set(outcomes) == {RelayOutcome.ACCEPTED}
    first, second = (result.fingerprint for result in results)
    queued = [order.fingerprint for order in orders[:4]]
    assert send_all(relay, Side.IPFS) == [first, queued[0], second, *queued[1:]]


def test_a_refused_message_is_dropped_and_counted(time: Time, journal: RelayJournal) -> None:
    relay, one = bridge(time, journal, SENIOR), message()
    relay.receive(one, Side.MESH)
    queued = relay.queues[Side.IPFS].next()
    assert queued is not None
    relay.refused(queued, Side.IPFS)
    assert relay.status(Side.IPFS, per_second=0).dropped == {"refused": 1}
    assert waiting(journal) == set()


def test_restored_messages_are_left_to_a_bridge_that_held_them_too(time: Time, journal: RelayJournal) -> None:
    relay = bridge(time, journal, JUNIOR, SENIOR)
    journal.add_waiting(Side.IPFS, QueuedMessage(message(), True, None, 0.0))
    journal.add_waiting(Side.IPFS, QueuedMessage(own := message(), False, None, 0.0))
    relay.restore()
    assert waiting(journal) == {own.fingerprint}
    relay.bridge_left(SENIOR)
    assert send_all(relay, Side.IPFS) == [own.fingerprint]


def test_the_deduplication_memory_is_bounded(time: Time) -> None:
    seen = SeenMessages(time)
    for number in range(DEDUPLICATION_LIMIT + 1):
        seen.add(number.to_bytes(16, "big"), Side.MESH)
    assert len(seen) == DEDUPLICATION_LIMIT
    assert not seen.contains((0).to_bytes(16, "big"), Side.MESH)
    relayed = RelayedMessages(time)
    for number in range(DEDUPLICATION_LIMIT + 1):
        relayed.add(number.to_bytes(16, "big"))
    assert len(relayed) == DEDUPLICATION_LIMIT


@pytest.mark.parametrize("rank", [SENIOR, Rank(True, 2**63, TWO)])
def test_a_rank_is_read_as_it_was_announced(rank: Rank) -> None:
    assert rank_of(PresenceKey(LIGHTHOUSE, rank.role, rank.bridge)) == rank


@pytest.mark.parametrize("role", ["bridge", "provider", "bridge-turn-2-0000000000000001", "bridge-turn-0-1"])
def test_other_tokens_are_not_ranks(role: str) -> None:
    assert rank_of(PresenceKey(LIGHTHOUSE, role, ONE)) is None
