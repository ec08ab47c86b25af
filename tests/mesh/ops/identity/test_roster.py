"""The roster: its contents, and the errors of an unusable one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from mesh.errors import ConfigurationError
from mesh.ops.identity import Member, Roster, entry_of, read_roster, roster_from
from mesh.ops.identity.certificates import with_fingerprint, with_member, write_roster
from tests.support.raising import raises_with

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
    ("text", "where", "value"),
    [
        ("x =", "it", "TOML"),
        ("nobody = 1", "it", "`nobody`"),
        ('lighthouses = ["a b"]', "it", "a lighthouse "),
        ('lighthouses = ["aira/**"]', "it", "a lighthouse "),
        (member(roles='["king"]'), "it, member 1, roles 1", "'king'"),
        (member() + member(name='"two"', roles='["agent", "king"]'), "it, member 2, roles 2", "'king'"),
        (member(roles="[]"), "it, member 'arm'", "no role"),
        (member(roles='"agent"'), "it, member 1, roles", "`array`"),
        (member(address=""), "it, member 1", "`address`"),
        (member(address='"0x12"'), "it, member 'arm'", "'0x12'"),
        (member(address='"*"'), "it, member 'arm'", "'*'"),
        (member(address=f'"{CHECKSUMMED.replace("c", "C")}"'), "it, member 'arm'", "EIP-55"),
        (member(fingerprint='"12"'), "it, member 'arm'", "SHA-256"),
        (member(revoked='"yes"'), "it, member 1, revoked", "`bool`"),
        (member(adress='"x"'), "it, member 1", "`adress`"),
        (member(agent=f'"{OTHER}"'), "it, member 'arm'", "role edge"),
        (member(roles='["edge"]', device='"a/**"'), "it, member 'arm'", "'a/**'"),
        (member(roles='["edge"]', device='"*"'), "it, member 'arm'", "'*'"),
        (member(name='"a\\nb"'), "it, member 1, name", ""),
        (member() + member(name='"two"'), "it", f"address '{ARM}'"),
        (member() + member(name='"two"', address=f'"{CHECKSUMMED}"'), "it", f"address '{ARM}'"),
        (member() + member(address=f'"{OTHER}"'), "it", "name 'arm'"),
    ],
)
def test_errors_name_the_place_in_the_roster(text: str, where: str, value: str) -> None:
    with raises_with(ConfigurationError, code="roster-unusable") as error:
        roster_from(text, where="it")

    assert str(error.value).startswith(f"the roster {where}: ")
    assert value in str(error.value)
    assert "\n" not in str(error.value)


def test_an_unknown_role_lists_the_roles() -> None:
    with raises_with(ConfigurationError, code="roster-unusable") as error:
        roster_from(member(roles='["king"]'), where="it")

    assert error.value.hint == "roles are agent, person, provider, validator, operator, edge, bridge, watcher, router"


def test_unreadable_files_are_named(tmp_path: Path) -> None:
    with raises_with(ConfigurationError, code="roster-unusable") as missing:
        read_roster(tmp_path / "none.toml")
    assert str(missing.value).startswith(f"the roster {tmp_path / 'none.toml'}: ")
    (tmp_path / "bytes.toml").write_bytes(b"\xff")
    with raises_with(ConfigurationError, code="roster-unusable") as unreadable:
        read_roster(tmp_path / "bytes.toml")
    assert str(unreadable.value).startswith(f"the roster {tmp_path / 'bytes.toml'}: ")


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
    with raises_with(ConfigurationError, code="roster-unusable") as outdated:
        with_fingerprint(file, ARM, old="ab" * 32, new="ef" * 32)
    assert str(outdated.value).startswith(f"the roster {file}, member 'arm': ")


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
    with raises_with(ConfigurationError, code="roster-unusable") as unknown:
        with_fingerprint(file, OTHER, old="ab" * 32, new="cd" * 32)
    assert str(unknown.value).startswith(f"the roster {file}: ")
    file.write_text(before + "revoked = true\n")
    with raises_with(ConfigurationError, code="roster-unusable") as revoked:
        with_fingerprint(file, ARM, old="ab" * 32, new="cd" * 32)
    assert str(revoked.value).startswith(f"the roster {file}, member 'arm': ")


def test_revoked_members_are_not_admitted() -> None:
    gone = Member(name="gone", address=OTHER, roles=("agent",), revoked=True)
    arm = Member(name="arm", address=ARM, roles=("agent",))

    roster = Roster(member=(gone, arm))

    assert roster.admitted() == (arm,)
    assert roster.find(OTHER) == gone
    assert roster.find("0x") is None
