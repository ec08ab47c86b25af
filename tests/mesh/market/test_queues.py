"""Queues by key: their order, removal from anywhere, and nothing left behind."""

from __future__ import annotations

import weakref

from hypothesis import given
from hypothesis import strategies as st

from mesh.market.queues import QueueNode, Queues


class Item:
    """Something that a weak reference can watch."""


def items(queues: Queues[str, int], key: str) -> list[int]:
    """What stands at `key`, taken out in turn."""
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


def test_what_came_first_is_first() -> None:
    queues, _ = filled(1, 2, 3)

    assert items(queues, "a") == [1, 2, 3]


def test_one_can_be_taken_out_of_the_front_the_middle_and_the_end() -> None:
    for gone in range(5):
        queues, nodes = filled(*range(5))
        queues.remove("a", nodes[gone])

        assert items(queues, "a") == [number for number in range(5) if number != gone]


def test_a_link_that_was_taken_out_may_stand_again_at_the_end() -> None:
    queues, nodes = filled(1, 2, 3)
    queues.remove("a", nodes[0])
    queues.append("a", nodes[0])

    assert items(queues, "a") == [2, 3, 1]


def test_keys_have_queues_of_their_own_and_an_empty_one_is_gone() -> None:
    queues, (node,) = filled(1)
    other = QueueNode(2)
    queues.append("b", other)
    assert (len(queues), set(queues)) == (2, {"a", "b"})

    queues.remove("a", node)

    assert (len(queues), set(queues), queues.first("a")) == (1, {"b"}, None)
    assert queues.first("b") is other


def test_nothing_holds_what_was_taken_out() -> None:
    queues: Queues[str, Item] = Queues()
    nodes = [QueueNode(Item()) for _ in range(3)]
    for node in nodes:
        queues.append("a", node)
    watched = weakref.ref(nodes[1].item)

    queues.remove("a", nodes.pop(1))
    del node

    assert watched() is None


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 9) | st.none())))
def test_it_does_what_lists_do(steps: list[tuple[str, int | None]]) -> None:
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
