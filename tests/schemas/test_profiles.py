"""Profiles: what a robot may say of itself, and what it signs."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from schemas import InvalidRecord
from schemas.profiles import PROFILE_LIMITS, Profile
from tests.support.orders import OBJECTIVE, PERSON, ROBOT

PROFILE = Profile(
    agent=ROBOT.address,
    model=OBJECTIVE,
    name="Lift 1",
    about="Lifts 1.2 t.",
    picture=OBJECTIVE,
    place="Hall 3",
    price="5 XRT",
    state="working",
    queue=2,
    wait=90,
    time=1_800_000_000,
)


def test_a_profile_travels_signed_by_its_robot() -> None:
    signed = PROFILE.signed_by(ROBOT)
    assert Profile.decode(signed.encode()) == signed
    assert signed.is_signed
    assert not PROFILE.signed_by(PERSON).is_signed
    assert not msgspec.structs.replace(signed, name="Lift 2").is_signed


def test_only_the_address_and_the_time_are_needed() -> None:
    least = Profile(agent=ROBOT.address, time=0).signed_by(ROBOT)
    assert Profile.decode(least.encode()).state == "idle"


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("agent", ROBOT.address.lower()),
        ("agent", "robot"),
        ("model", "model.json"),
        ("name", "n" * (PROFILE_LIMITS.name + 1)),
        ("name", "0xLift"),
        ("name", "two\nlines"),
        ("name", "right\u202eleft"),
        ("name", " Lift"),
        ("about", "a" * (PROFILE_LIMITS.about + 1)),
        ("about", "\x1b[2J"),
        ("place", "p" * (PROFILE_LIMITS.name + 1)),
        ("picture", "https://example.org/lift.png"),
        ("price", "cheap"),
        ("state", "asleep"),
        ("queue", -1),
        ("queue", PROFILE_LIMITS.waiting + 1),
        ("wait", -1),
    ],
)
def test_a_profile_out_of_range_is_refused(field: str, value: Any) -> None:
    payload = msgspec.json.encode(msgspec.to_builtins(PROFILE) | {field: value})
    with pytest.raises(InvalidRecord):
        Profile.decode(payload)
