"""Queues by key: order, removal, and memory."""

from __future__ import annotations

import weakref

from hypothesis import given
from hypothesis import strategies as st

from mesh.market.queues import QueueNode, Queues


class Item:
    """An object that can have a weak reference."""


def items(queues: Queues[str, int], key: str) -> list[int]:
    """The items at `key`, removed one after the other."""
    taken = []
    while (node := queues.first(key)) is not None:
        queues.remove(key, node)
        taken.append(node.item)
    return taken


def filled(*numbers: int, key: str = "a") -> tuple[Queues[str, int], list[QueueNode[int]]]:
    queues: Queues[str, int] = Queues()
    nodes = [QueueNode(number) for number in numbers]
    for node in nodes:
        queues.append(key, node)
    return queues, nodes


def test_a_key_without_a_queue_has_no_first() -> None:
    assert Queues[str, int]().first("a") is None


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
    other = QueueNode(2)
    queues.append("b", other)
    assert queues.first("a") is node

    queues.remove("a", node)

    assert queues.first("a") is None
    assert queues._first.keys() == {"b"}
    assert queues.first("b") is other


def test_the_queues_hold_no_reference_to_a_removed_item() -> None:
    queues: Queues[str, Item] = Queues()
    nodes = [QueueNode(Item()) for _ in range(3)]
    for node in nodes:
        queues.append("a", node)
    watched = weakref.ref(nodes[1].item)

    queues.remove("a", nodes.pop(1))
    del node

    assert watched() is None


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 9) | st.none())))
def test_the_queues_behave_like_lists(steps: list[tuple[str, int | None]]) -> None:
    queues: Queues[str, int] = Queues()
    expected: dict[str, list[QueueNode[int]]] = {key: [] for key in "abc"}
    for number, (key, position) in enumerate(steps):
        if position is None:
            node = QueueNode(number)
            queues.append(key, node)
            expected[key].append(node)
        elif expected[key]:
            queues.remove(key, expected[key].pop(position % len(expected[key])))
        assert {key: queues.first(key) for key in "abc"} == {
            key: nodes[0] if nodes else None for key, nodes in expected.items()
        }
    for key, nodes in expected.items():
        assert items(queues, key) == [node.item for node in nodes]
