"""Queues by key: order, removal, and memory."""

from __future__ import annotations

import weakref

from hypothesis import given
from hypothesis import strategies as st

from mesh.market.book import Queues


class Item:
    """An item with its neighbours in one kind of queue."""

    __slots__ = ("__weakref__", "after_test", "before_test", "number")

    def __init__(self, number: int) -> None:
        self.number = number


def empty() -> Queues[str, Item]:
    return Queues("test")


def items(queues: Queues[str, Item], key: str) -> list[int]:
    """The items at `key`, removed one after the other."""
    taken = []
    while (item := queues.first(key)) is not None:
        queues.remove(key, item)
        taken.append(item.number)
    return taken


def filled(*numbers: int, key: str = "a") -> tuple[Queues[str, Item], list[Item]]:
    queues = empty()
    nodes = [Item(number) for number in numbers]
    for node in nodes:
        queues.append(key, node)
    return queues, nodes


def test_a_key_without_a_queue_has_no_first() -> None:
    assert empty().first("a") is None


def test_the_oldest_node_is_first() -> None:
    queues, _ = filled(1, 2, 3)

    assert items(queues, "a") == [1, 2, 3]


def test_a_node_can_be_removed_from_front_middle_and_end() -> None:
    for gone in range(5):
        queues, nodes = filled(*range(5))
        queues.remove("a", nodes[gone])

        assert items(queues, "a") == [number for number in range(5) if number != gone]


def test_a_removed_node_can_be_appended_again() -> None:
    queues, nodes = filled(1, 2, 3)
    queues.remove("a", nodes[0])
    queues.append("a", nodes[0])

    assert items(queues, "a") == [2, 3, 1]


def test_each_key_has_its_own_queue_and_an_empty_queue_is_dropped() -> None:
    queues, (node,) = filled(1)
    other = Item(2)
    queues.append("b", other)
    assert queues.first("a") is node

    queues.remove("a", node)

    assert queues.first("a") is None
    assert queues._first.keys() == {"b"}
    assert queues.first("b") is other


def test_the_queues_hold_no_reference_to_a_removed_item() -> None:
    queues, nodes = filled(1, 2, 3)
    watched = weakref.ref(nodes[1])

    queues.remove("a", nodes.pop(1))

    assert watched() is None


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 9) | st.none())))
def test_the_queues_behave_like_lists(steps: list[tuple[str, int | None]]) -> None:
    queues = empty()
    expected: dict[str, list[Item]] = {key: [] for key in "abc"}
    for number, (key, position) in enumerate(steps):
        if position is None:
            node = Item(number)
            queues.append(key, node)
            expected[key].append(node)
        elif expected[key]:
            queues.remove(key, expected[key].pop(position % len(expected[key])))
        for ends, place in ((queues.first, 0), (queues.last, -1)):
            assert {key: ends(key) for key in "abc"} == {
                key: nodes[place] if nodes else None for key, nodes in expected.items()
            }
    for key, nodes in expected.items():
        assert list(queues.items(key)) == nodes
        assert items(queues, key) == [node.number for node in nodes]
