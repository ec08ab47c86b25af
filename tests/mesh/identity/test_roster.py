"""The roster: its contents, and the errors of an unusable one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from mesh.identity import Member, Roster, RosterError, entry_of, read_roster, roster_from
from mesh.identity.folders import with_fingerprint, with_member, write_roster

if TYPE_CHECKING:
    from pathlib import Path

ARM = "0x00000000219ab540356cbb839cbe05303d7705fa"
CHECKSUMMED = "0x00000000219ab540356cBB839Cbe05303d7705Fa"
OTHER = "0x" + "0b" * 20


def member(**more: str) -> str:
    fields = {"name": '"arm"', "address": f'"{ARM}"', "roles": '["agent"]'} | more
    return "[[member]]\n" + "".join(f"{name} = {value}\n" for name, value in fields.items() if value)


def test_an_empty_roster_has_both_markets_and_no_members() -> None:
    roster = roster_from("", where="it")

    assert roster.member == ()
    assert roster.lighthouses == ("airalab.lighthouse.3.robonomics.eth", "airalab.lighthouse.5.robonomics.eth")


def test_addresses_and_fingerprints_are_normalised_to_lower_case() -> None:
    text = 'lighthouses = ["My.Lighthouse.3.Robonomics.ETH"]\n' + member(
        address=f'"{CHECKSUMMED}"', fingerprint='"' + ":".join(["AB"] * 32) + '"'
    )

    roster = roster_from(text, where="it")

    assert roster.lighthouses == ("my.lighthouse.3.robonomics.eth",)
    assert roster.member == (Member(name="arm", address=ARM, roles=("agent",), fingerprint="ab" * 32),)


def test_an_edge_agent_serves_its_own_device_unless_another_is_named() -> None:
    own, named = (
        roster_from(member(roles='["edge"]', **more), where="it").member[0]
        for more in ({}, {"agent": f'"{OTHER}"', "device": '"gripper"'})
    )

    assert (own.agent, own.device) == (ARM, "arm")
    assert (named.agent, named.device) == (OTHER, "gripper")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x =", "the roster it: it is not TOML: "),
        ("nobody = 1", "the roster it: there is no field `nobody`"),
        ('lighthouses = ["a b"]', "a lighthouse is named by an ENS name or an address"),
        ('lighthouses = ["aira/**"]', "a lighthouse is named by an ENS name or an address"),
        (member(roles='["king"]'), "the roster it, member 1, roles 1: there is no role 'king'"),
        (
            member() + member(name='"two"', roles='["agent", "king"]'),
            "the roster it, member 2, roles 2: there is no role",
        ),
        (member(roles="[]"), "the roster it, member 'arm': it has no role"),
        (member(roles='"agent"'), "the roster it, member 1, roles: Expected `array`"),
        (member(address=""), "the roster it, member 1: it has no `address`"),
        (member(address='"0x12"'), "the roster it, member 'arm': '0x12' is not an address"),
        (member(address='"*"'), "the roster it, member 'arm': '*' is not an address"),
        (member(address=f'"{CHECKSUMMED.replace("c", "C")}"'), "its EIP-55 checksum does not hold"),
        (member(fingerprint='"12"'), "the roster it, member 'arm': its fingerprint is not SHA-256"),
        (member(revoked='"yes"'), "the roster it, member 1, revoked: Expected `bool`"),
        (member(adress='"x"'), "the roster it, member 1: there is no field `adress`"),
        (member(agent=f'"{OTHER}"'), "the roster it, member 'arm': only a member with the role edge serves a device"),
        (member(roles='["edge"]', device='"a/**"'), "the roster it, member 'arm': 'a/**' is not"),
        (member(roles='["edge"]', device='"*"'), "the roster it, member 'arm': '*' is not"),
        (member(name='"a\\nb"'), "the roster it, member 1, name: "),
        (member() + member(name='"two"'), f"the roster it: the address '{ARM}' occurs twice"),
        (member() + member(name='"two"', address=f'"{CHECKSUMMED}"'), f"the address '{ARM}' occurs twice"),
        (member() + member(address=f'"{OTHER}"'), "the roster it: the name 'arm' occurs twice"),
    ],
)
def test_errors_name_the_place_in_the_roster(text: str, said: str) -> None:
    with pytest.raises(RosterError) as error:
        roster_from(text, where="it")

    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_an_unknown_role_lists_the_roles() -> None:
    with pytest.raises(RosterError) as error:
        roster_from(member(roles='["king"]'), where="it")

    assert error.value.hint == "roles are agent, person, provider, operator, edge, bridge, watcher, router"


def test_unreadable_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(RosterError, match="No such file or directory"):
        read_roster(tmp_path / "none.toml")
    (tmp_path / "bytes.toml").write_bytes(b"\xff")
    with pytest.raises(RosterError, match="it is not UTF-8 text"):
        read_roster(tmp_path / "bytes.toml")


def test_an_entry_reads_back_as_its_member() -> None:
    odd = Member(name='Ann "Ä" \\ Lee', address=ARM, roles=("edge", "person"), agent=OTHER, device="x-1")

    assert roster_from(entry_of(odd), where="it").member == (odd,)


def test_adding_a_member_keeps_the_rest_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "new" / "roster.toml"
    arm = Member(name="arm", address=ARM, roles=("agent",), fingerprint="ab" * 32)

    write_roster(file, with_member(file, arm))
    file.write_text("# ours\n" + file.read_text().rstrip("\n"))
    write_roster(file, with_member(file, Member(name="two", address=OTHER, roles=("watcher",))))
    write_roster(file, with_fingerprint(file, ARM, old="ab" * 32, new="cd" * 32))

    assert file.read_text().startswith("# ours\n[[member]]\n")
    assert [(one.name, one.fingerprint) for one in read_roster(file).member] == [("arm", "cd" * 32), ("two", "")]
    assert [path.name for path in file.parent.iterdir()] == ["roster.toml"]
    with pytest.raises(RosterError, match="member 'arm': its certificate has another fingerprint"):
        with_fingerprint(file, ARM, old="ab" * 32, new="ef" * 32)


def test_a_fingerprint_is_replaced_in_any_spelling(tmp_path: Path) -> None:
    file = tmp_path / "roster.toml"
    arm = Member(name="arm", address=ARM, roles=("agent",), fingerprint="ab" * 32)
    write_roster(file, entry_of(arm).replace("ab" * 32, ":".join(["AB"] * 32)))

    write_roster(file, with_fingerprint(file, ARM, old="ab" * 32, new="cd" * 32))

    assert [one.fingerprint for one in read_roster(file).member] == ["cd" * 32]


def test_a_member_without_a_fingerprint_is_renewed_and_a_revoked_one_or_a_stranger_is_not(tmp_path: Path) -> None:
    file = tmp_path / "roster.toml"
    write_roster(file, entry_of(Member(name="arm", address=ARM, roles=("agent",))))
    before = file.read_text()

    assert with_fingerprint(file, ARM, old="ab" * 32, new="cd" * 32) == before
    with pytest.raises(RosterError, match=f"no member has the address {OTHER}"):
        with_fingerprint(file, OTHER, old="ab" * 32, new="cd" * 32)
    file.write_text(before + "revoked = true\n")
    with pytest.raises(RosterError, match="member 'arm': it is revoked, so its certificate is not renewed"):
        with_fingerprint(file, ARM, old="ab" * 32, new="cd" * 32)


def test_revoked_members_are_not_admitted() -> None:
    gone = Member(name="gone", address=OTHER, roles=("agent",), revoked=True)
    arm = Member(name="arm", address=ARM, roles=("agent",))

    roster = Roster(member=(gone, arm))

    assert roster.admitted() == (arm,)
    assert roster.find(OTHER) == gone
    assert roster.find("0x") is None
