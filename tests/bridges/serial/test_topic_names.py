"""Names of topics in the mesh."""

from __future__ import annotations

import pytest

from bridges.serial.cli import topic_names
from mesh.errors import InputError, InvalidKey


def test_topics_keep_their_names_unless_renamed() -> None:
    assert topic_names()("/led") == "/led"
    assert topic_names([("/lamp", "/x")])("/lamps") == "/lamps"


def test_a_name_also_renames_all_below_it_and_the_longest_applies() -> None:
    names = topic_names([("/", "/left"), ("/arm", "/hand"), ("/arm/finger", "/")])
    given = ("/led", "/arm", "/arm/joint", "/arm/finger/tip", "/arm/finger")
    assert [names(name) for name in given] == ["/left/led", "/hand", "/hand/joint", "/tip", "/arm/finger"]


def test_invalid_names_are_refused() -> None:
    with pytest.raises(InvalidKey):
        topic_names([("/a b", "/c")])
    with pytest.raises(InvalidKey):
        topic_names([("/a", "c")])
    with pytest.raises(InputError):
        topic_names([("/a", "/b"), ("/a", "/c")])
