"""`aira identity renew` as a timer calls it: several members at once, and those only that expire soon."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from mesh.ops.identity import read_roster
from tests.mesh.cli.test_identity import ARM, OTHER, made, site
from tests.support.commands import invoke

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["site"]


def test_only_certificates_that_expire_soon_are_renewed(tmp_path: Path, site: Path) -> None:
    roster = tmp_path / "roster.toml"
    soon = made(tmp_path / "soon", site, "--address", ARM, "--role", "agent", "--days", "29", "--roster", roster)
    later = made(
        tmp_path / "later", site, "--address", OTHER, "--role", "agent", "--days", "31", "--roster", roster, name="leg"
    )
    command = ("identity", "renew", tmp_path / "soon", tmp_path / "later", "--site", site, "--roster", roster)

    done = invoke(*command, "--within", "30", "--json")

    renewed, left = map(json.loads, done.stdout.splitlines())
    assert renewed["validUntil"] > str(soon["validUntil"])
    assert left == later
    assert [member.fingerprint for member in read_roster(roster).member] == [
        renewed["fingerprint"],
        later["fingerprint"],
    ]
    again = invoke(*command, "--within", "30").stdout
    assert again.splitlines() == ["arm is valid for 89 more days", "leg is valid for 30 more days"]


def test_a_failed_renewal_does_not_prevent_the_others(tmp_path: Path, site: Path) -> None:
    made(tmp_path / "arm", site, "--address", ARM, "--role", "agent", "--days", "1")

    done = invoke("identity", "renew", tmp_path / "nobody", tmp_path / "arm", "--site", site, "--within", "30")

    assert done.returncode == 2
    assert f"{tmp_path}/nobody/identity.pem: can't read it" in done.stderr
    assert "89 days left" in done.stdout


def test_revoked_members_are_not_renewed_and_each_failure_is_printed(tmp_path: Path, site: Path) -> None:
    """The roster shuts an address out; a new certificate for it would outlive the day on which it is let in again."""
    roster = tmp_path / "roster.toml"
    for name, address in (("gone", ARM), ("leg", OTHER)):
        made(
            tmp_path / name, site, "--address", address, "--role", "agent", "--days", "1", "--roster", roster, name=name
        )
    roster.write_text(roster.read_text().replace('name = "gone"', 'name = "gone"\nrevoked = true'))
    before = (tmp_path / "gone" / "identity.pem").read_bytes()

    folders = [tmp_path / "nobody", tmp_path / "gone", tmp_path / "leg"]
    done = invoke("identity", "renew", *folders, "--site", site, "--roster", roster, "--within", "30")

    assert done.returncode == 2
    assert "nobody/identity.pem: can't read it" in done.stderr
    assert "member 'gone': it is revoked, so its certificate is not renewed" in done.stderr
    assert (tmp_path / "gone" / "identity.pem").read_bytes() == before
    assert "89 days left" in done.stdout
    assert [member.revoked for member in read_roster(roster).member] == [True, False]


def test_a_certificate_is_renewed_without_its_key(tmp_path: Path, site: Path) -> None:
    """The site's key stays with the site, and the member's with the member: only certificates travel."""
    folder = tmp_path / "arm"
    before = made(folder, site, "--address", ARM, "--role", "agent", "--days", "1")
    key = (folder / "identity.key").read_bytes()
    (folder / "identity.key").unlink()

    done = invoke("identity", "renew", folder, "--site", site)

    assert done.returncode == 0
    (folder / "identity.key").write_bytes(key)
    shown = json.loads(invoke("identity", "show", folder, "--json").stdout)  # the two are a pair
    assert shown["fingerprint"] != before["fingerprint"]
