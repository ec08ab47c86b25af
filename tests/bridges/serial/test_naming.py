from __future__ import annotations

import pytest

from bridges.serial.naming import TopicNames
from mesh.errors import InputError, InvalidKey


def test_topics_have_their_own_names_unless_others_are_given() -> None:
    assert TopicNames().of("/led") == "/led"
    assert TopicNames([("/lamp", "/x")]).of("/lamps") == "/lamps"


def test_a_name_stands_for_all_beneath_it_and_the_longest_counts() -> None:
    names = TopicNames([("/", "/left"), ("/arm", "/hand"), ("/arm/finger", "/")])
    given = ("/led", "/arm", "/arm/joint", "/arm/finger/tip", "/arm/finger")
    assert [names.of(name) for name in given] == ["/left/led", "/hand", "/hand/joint", "/tip", "/arm/finger"]


def test_what_can_be_no_name_is_refused() -> None:
    with pytest.raises(InvalidKey):
        TopicNames([("/a b", "/c")])
    with pytest.raises(InvalidKey):
        TopicNames([("/a", "c")])
    with pytest.raises(InputError, match="two names"):
        TopicNames([("/a", "/b"), ("/a", "/c")])
