"""From the roster to Zenoh's rules, without any Zenoh."""

from __future__ import annotations

from typing import get_args

import pytest

from mesh.ops.identity import ROLES, Member, Right, Role, Roster, access_control, access_of
from schemas.keys import Key

ARM = "0x00000000219ab540356cbb839cbe05303d7705fa"
OTHER = "0x" + "0b" * 20
MARKET = "a.lighthouse.3.robonomics.eth"


def roster(*roles: Role, **more: str) -> Roster:
    return Roster(lighthouses=(MARKET,), member=(Member(name="arm", address=ARM, roles=roles, **more),))  # type: ignore[arg-type]


def allowed(roles: tuple[Role, ...], right: Right, **more: str) -> set[str]:
    return {key for one in access_of(roster(*roles, **more)) if one.right is right for key in one.keys}


def test_every_role_has_its_grants_and_every_grant_names_keys_of_the_mesh() -> None:
    assert set(ROLES) == set(get_args(Role))
    keys = {key for role in ROLES for grant in ROLES[role] for key in grant.keys}
    assert all(key.startswith("aira/") for key in keys)


def test_every_family_of_keys_may_be_written_by_somebody() -> None:
    """The families with a `put` or a `serve` of their own; a new family must be thought of here."""
    written = {str(one) for one in get_args(Key)}
    assert len(written) == 23
    grants = {
        key for role, grants in ROLES.items() if role != "router" for grant in grants for key in grant.keys
        if grant.rights & {Right.PUT, Right.SERVE, Right.TOKEN}
    }  # fmt: skip
    for chunk in (
        "demand",
        "offer",
        "withdrawal",
        "permit",
        "result",
        "feedback",
        "pending",
        "created",
        "reject",
        "decline",
        "report",
        "validator",
        "@agent",
        "aira/agent/{own}",
    ):
        assert any(chunk in key for key in grants), chunk


def test_a_member_deletes_only_in_its_own_space() -> None:
    for role in ROLES:
        if role != "router":
            assert allowed((role,), Right.DELETE) <= {f"aira/agent/{ARM}/**"}


@pytest.mark.parametrize("role", [role for role in ROLES if role != "router"])
def test_no_member_can_write_as_another(role: Role) -> None:
    for right in (Right.PUT, Right.DELETE, Right.TOKEN):
        for key in allowed((role,), right, agent=ARM, device="arm"):
            assert ARM in key or key.startswith(f"aira/{MARKET}/"), key
            assert "**" not in key.removesuffix("/**"), key
    assert not {"aira/**", "aira/*/**", "**"} & allowed((role,), Right.GET)


def test_an_edge_agent_writes_for_its_agent_and_nowhere_else() -> None:
    written = allowed(("edge",), Right.PUT, agent=OTHER, device="board")

    assert written == {f"aira/agent/{OTHER}/device/board/**", f"aira/agent/{OTHER}/liability/*/topic/**"}


def test_the_rights_of_several_roles_are_combined() -> None:
    both = allowed(("agent", "person"), Right.PUT)

    assert both == allowed(("agent",), Right.PUT) | allowed(("person",), Right.PUT)


def test_only_the_markets_of_the_roster_are_open() -> None:
    two = Roster(lighthouses=(MARKET, "b.eth"), member=(Member(name="ann", address=ARM, roles=("person",)),))

    puts = next(one.keys for one in access_of(two) if one.right is Right.PUT)

    markets = [f"aira/{market}/{keys}" for keys in ("demand/*", "withdrawal", "permit") for market in (MARKET, "b.eth")]
    assert set(puts) == {f"aira/agent/{ARM}/**", *markets}


def test_zenoh_denies_by_default_and_knows_both_spellings_of_an_address() -> None:
    rules = access_control(roster("watcher"))

    assert (rules["enabled"], rules["default_permission"]) == (True, "deny")
    assert {rule["permission"] for rule in rules["rules"]} == {"allow"}
    assert rules["subjects"] == [{"id": ARM, "cert_common_names": [ARM, "0x00000000219ab540356cBB839Cbe05303d7705Fa"]}]
    assert len({rule["id"] for rule in rules["rules"]}) == len(rules["rules"])
    assert set(rules["policies"][0]["rules"]) == {rule["id"] for rule in rules["rules"]}
    assert not any("put" in rule["messages"] and "ingress" in rule["flows"] for rule in rules["rules"])


def test_an_empty_roster_denies_everything() -> None:
    rules = access_control(Roster(lighthouses=(MARKET,)))

    assert (rules["enabled"], rules["default_permission"], rules["subjects"]) == (True, "deny", [])


def test_revoked_members_have_no_rights() -> None:
    gone = Roster(lighthouses=(MARKET,), member=(Member(name="arm", address=ARM, roles=("agent",), revoked=True),))

    assert list(access_of(gone)) == []
    assert access_control(gone)["subjects"] == []
