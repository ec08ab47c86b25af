"""`aira identity`: a site and its members, made, shown and renewed; keys stay where they are."""

from __future__ import annotations

import json
import time
from typing import TYPE_CHECKING

import pytest

from mesh.chain import new_private_key, write_keyfile
from mesh.errors import ConfigurationError, InputError
from mesh.network import Endpoints, Tls
from mesh.ops.identity import Member, read_roster
from tests.support.commands import invoke, refused
from tests.support.sites import Site

if TYPE_CHECKING:
    import subprocess
    from pathlib import Path

    from mesh.errors import AiraError
    from mesh.ops.identity.certificates import MemberFolder

ARM = "0x" + "0a" * 20
OTHER = "0x" + "0b" * 20


@pytest.fixture
def site(tmp_path: Path) -> Path:
    folder = tmp_path / "site"
    done = invoke("identity", "site", folder)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"certificate  {folder}/ca.pem\nkey          {folder}/ca.key\n"
    return folder


def test_a_sites_files_are_named_for_programs(tmp_path: Path) -> None:
    done = invoke("identity", "site", tmp_path / "site", "--json")
    assert json.loads(done.stdout) == {"certificate": f"{tmp_path}/site/ca.pem", "key": f"{tmp_path}/site/ca.key"}


def new(folder: Path, site: Path, *more: str | Path, name: str = "arm") -> subprocess.CompletedProcess[str]:
    return invoke("identity", "new", folder, "--site", site, "--name", name, *more)


def made(folder: Path, site: Path, *more: str | Path, name: str = "arm") -> dict[str, object]:
    done = new(folder, site, "--json", *more, name=name)
    assert done.returncode == 0, done.stderr
    found: dict[str, object] = json.loads(done.stdout)
    return found


def test_the_common_name_of_a_members_identity_is_its_address(tmp_path: Path, site: Path) -> None:
    folder = tmp_path / "arm"

    found = made(folder, site, "--address", ARM.upper().replace("X", "x"), "--role", "agent", "--role", "person")

    tls = Tls(ca=folder / "ca.pem", certificate=folder / "identity.pem", key=folder / "identity.key")
    Endpoints(connect=("tls/127.0.0.1:7447",), tls=tls).config()  # takes files that can work only
    assert (found["name"], found["address"], found["roles"]) == ("arm", ARM, ["agent", "person"])
    assert found["expired"] is False
    assert json.loads(invoke("identity", "show", folder, "--json").stdout) == found


def test_show_prints_name_address_role_validity_and_fingerprint(tmp_path: Path, site: Path) -> None:
    found = made(tmp_path / "arm", site, "--address", ARM, "--role", "agent", "--days", "30")

    lines = invoke("identity", "show", tmp_path / "arm").stdout.splitlines()

    assert lines[:3] == ["name         arm", f"address      {ARM}", "roles        agent"]
    assert lines[4].startswith("valid until  ")
    assert lines[4].endswith("(29 days left)")
    assert lines[5] == f"fingerprint  {found['fingerprint']}"


def test_the_address_may_come_from_a_keyfile(tmp_path: Path, site: Path) -> None:
    address = write_keyfile(tmp_path / "keyfile", new_private_key(), "secret")

    found = made(tmp_path / "arm", site, "--keyfile", tmp_path / "keyfile", "--role", "agent")

    assert found["address"] == address.lower()


def test_no_key_is_ever_shown_and_only_its_owner_can_read_it(tmp_path: Path, site: Path) -> None:
    folder = tmp_path / "arm"
    commands = [
        new(folder, site, "--address", ARM, "--role", "agent"),
        invoke("identity", "show", folder),
        invoke("identity", "renew", folder, "--site", site),
        new(folder, site, "--address", ARM, "--role", "agent"),
    ]

    for key in (site / "ca.key", folder / "identity.key"):
        assert key.stat().st_mode & 0o777 == 0o600
        secret = "".join(key.read_text().splitlines()[1:-1])
        assert not any(secret[:20] in done.stdout + done.stderr for done in commands)


def test_nothing_is_overwritten(tmp_path: Path, site: Path) -> None:
    folder = tmp_path / "arm"
    made(folder, site, "--address", ARM, "--role", "agent")
    before = {path: path.read_bytes() for path in (*folder.iterdir(), *site.iterdir())}

    again = new(folder, site, "--address", OTHER, "--role", "agent")

    refused(again, ConfigurationError, f"{folder}/identity.pem")
    refused(invoke("identity", "site", site), ConfigurationError, f"{site}/ca.pem")
    assert {path: path.read_bytes() for path in before} == before


def test_a_new_identity_is_added_to_the_roster_without_changing_other_lines(tmp_path: Path, site: Path) -> None:
    roster = tmp_path / "roster.toml"
    roster.write_text("# our site\nlighthouses = []\n")

    arm = made(tmp_path / "arm", site, "--address", ARM, "--role", "agent", "--roster", roster)
    more = ("--role", "edge", "--agent", ARM, "--device", "gripper", "--roster", roster)
    made(tmp_path / "board", site, "--address", OTHER, *more, name="board")

    assert roster.read_text().startswith("# our site\nlighthouses = []\n")
    first, second = read_roster(roster).member
    assert (first.address, first.roles, first.fingerprint) == (ARM, ("agent",), arm["fingerprint"])
    assert (second.agent, second.device) == (ARM, "gripper")
    shown = invoke("identity", "show", tmp_path / "arm", "--roster", roster).stdout
    assert shown.splitlines()[-1] == "roster       in the roster as agent"


def test_a_member_that_the_roster_can_not_hold_gets_no_certificate(tmp_path: Path, site: Path) -> None:
    roster = tmp_path / "roster.toml"
    made(tmp_path / "arm", site, "--address", ARM, "--role", "agent", "--roster", roster)

    twice = new(tmp_path / "again", site, "--address", ARM, "--role", "agent", "--roster", roster, name="again")

    refused(twice, "roster-unusable", roster, ARM)
    assert not (tmp_path / "again").exists()


def test_renewal_keeps_holder_and_key_and_updates_the_roster(tmp_path: Path, site: Path) -> None:
    folder, roster = tmp_path / "arm", tmp_path / "roster.toml"
    before = made(folder, site, "--address", ARM, "--role", "agent", "--days", "0.5", "--roster", roster)
    key = (folder / "identity.key").read_bytes()

    done = invoke("identity", "renew", folder, "--site", site, "--days", "30", "--roster", roster, "--json")

    after = json.loads(done.stdout)
    assert after["validUntil"] > str(before["validUntil"])
    assert [after[fact] for fact in ("name", "address", "roles")] == [
        before[fact] for fact in ("name", "address", "roles")
    ]
    assert (folder / "identity.key").read_bytes() == key
    assert read_roster(roster).member[0].fingerprint == after["fingerprint"] != before["fingerprint"]
    assert sorted(path.name for path in folder.iterdir()) == ["ca.pem", "identity.key", "identity.pem"]


def test_show_compares_the_certificate_with_the_roster(tmp_path: Path, site: Path) -> None:
    folder, roster = tmp_path / "arm", tmp_path / "roster.toml"
    made(folder, site, "--address", ARM, "--role", "agent", "--roster", roster)
    text = roster.read_text()

    def standing() -> object:
        return json.loads(invoke("identity", "show", folder, "--roster", roster, "--json").stdout)["roster"]

    roster.write_text(text + "revoked = true\n")
    assert standing() == "revoked"
    roster.write_text(text.replace(read_roster(roster).member[0].fingerprint, "ab" * 32))
    assert standing() == "in the roster, with another certificate"
    roster.write_text("")
    assert standing() == "not in the roster"


def test_a_routers_identity_needs_a_host_and_no_account(tmp_path: Path, site: Path) -> None:
    found = made(tmp_path / "hub", site, "--role", "router", "--host", "127.0.0.1", "--host", "hub.example", name="hub")

    assert found["hosts"] == ["127.0.0.1", "hub.example"] or found["hosts"] == ["hub.example", "127.0.0.1"]
    nowhere = new(tmp_path / "two", site, "--role", "router", name="two")
    refused(nowhere, "invalid-options", "--host")


@pytest.mark.parametrize(
    ("more", "error", "value"),
    [
        (("--role", "agent"), "invalid-options", "address"),
        (("--role", "agent", "--address", "0x12"), "roster-unusable", "'0x12'"),
        (("--role", "agent", "--address", ARM, "--agent", OTHER), "roster-unusable", "device"),
        (("--role", "router", "--address", ARM, "--host", "a host"), InputError, "a host"),
    ],
)
def test_an_invalid_member_is_one_clear_line(
    tmp_path: Path, site: Path, more: tuple[str, ...], error: type[AiraError], value: str
) -> None:
    refused(new(tmp_path / "arm", site, *more), error, value)
    assert not (tmp_path / "arm").exists()


def test_errors_name_files_that_are_no_identity(tmp_path: Path, site: Path) -> None:
    folder = tmp_path / "arm"
    made(folder, site, "--address", ARM, "--role", "agent")
    made(tmp_path / "other", site, "--address", OTHER, "--role", "agent", name="other")
    certificate, key = folder / "identity.pem", folder / "identity.key"
    good = certificate.read_bytes()

    refused(invoke("identity", "show", tmp_path / "nobody"), "identity-unusable", "No such file or directory")
    key.write_bytes((tmp_path / "other" / "identity.key").read_bytes())
    refused(invoke("identity", "show", folder), "identity-unusable", key, "belong")
    key.write_text("rubbish")
    refused(invoke("identity", "show", folder), "identity-unusable", key, "PEM")
    certificate.write_text("rubbish")
    refused(invoke("identity", "show", folder), "identity-unusable", certificate, "PEM")
    key.unlink()
    certificate.write_bytes((site / "ca.pem").read_bytes())
    refused(invoke("identity", "show", folder), "identity-unusable", certificate, "'AIRA mesh site'")
    certificate.write_bytes(good)
    other_site = tmp_path / "elsewhere"
    invoke("identity", "site", other_site)
    refused(
        invoke("identity", "renew", folder, "--site", other_site), "identity-unusable", f"{folder}/ca.pem", other_site
    )
    assert certificate.read_bytes() == good


def test_an_expired_site_signs_nothing(tmp_path: Path) -> None:
    invoke("identity", "site", tmp_path / "site", "--days", "0.000001")
    time.sleep(1.1)  # certificates are valid for whole seconds

    done = new(tmp_path / "arm", tmp_path / "site", "--address", ARM, "--role", "agent")

    refused(done, "identity-unusable", f"{tmp_path}/site/ca.pem", "expired")


def test_check_distinguishes_admitted_members_from_refused_ones(tmp_path: Path) -> None:
    site = Site(tmp_path / "closed")
    board = Member(name="board", address=OTHER, roles=("edge",), agent=ARM, device="gripper")
    members = [
        site.enlist(Member(name="arm", address=ARM, roles=("agent",))),
        site.enlist(Member(name="screen", address="0x" + "0c" * 20, roles=("watcher",))),
        site.enlist(board),
    ]
    gone = site.enlist(Member(name="gone", address="0x" + "0d" * 20, roles=("agent",), revoked=True))
    stranger = site.certify("stranger", "0x" + "0e" * 20, "agent")

    def check(folder: MemberFolder, *more: str) -> subprocess.CompletedProcess[str]:
        own = ("--tls-certificate", folder.certificate, "--tls-key", folder.key)
        return invoke("identity", "check", "--connect", site.endpoint, "--tls-ca", folder.ca, *own, *more)

    with site.open_router("wheel"):
        arm, screen = (check(folder) for folder in members[:2])
        edge = check(members[2], "--agent", ARM, "--device", "gripper")
        for folder, address in ((gone, "0x" + "0d" * 20), (stranger, "0x" + "0e" * 20)):
            done = check(folder)
            refused(done, "identity-denied", address)

    assert (arm.returncode, arm.stdout) == (0, f"{site.endpoint} admits {ARM} and forwards its messages\n")
    assert (screen.returncode, edge.returncode) == (0, 0), (screen.stderr, edge.stderr)


def test_check_without_an_identity_is_an_error_with_a_hint() -> None:
    refused(invoke("identity", "check"), "identity-missing")
