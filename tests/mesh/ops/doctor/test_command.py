"""`aira doctor`: its lines, its objects, its exit code, and what it never shows."""

from __future__ import annotations

import json
import os
import re
import socket
import sys
from typing import TYPE_CHECKING, Any

from mesh.ops.doctor import DoctorContext
from mesh.ops.doctor.checks import CertificateInfo, SerialSettings
from mesh.ops.identity import Member
from mesh.settings import Settings
from tests.support.cli.served_chain import PASSWORD, ServedChain
from tests.support.commands import aira, run
from tests.support.doctor.examining import settings_of
from tests.support.ports import free_port
from tests.support.sites import Site
from tests.support.waiting import at_most

if TYPE_CHECKING:
    import subprocess
    from pathlib import Path

    from tests.support.routers import EmbeddedRouter

LINE = re.compile(r"(?P<mark>ok|warn|FAIL) +(?P<name>\S+(?: \S+)*)  +(?P<found>\S.*)")
ARM = "0x" + "0a" * 20
PATIENT = ("--timeout", "90")
"""For checks that pass, also on a busy machine."""
BUSY_DISK = "; with warnings: data folder"
"""The end of the last line if other programs keep the disk busy."""


def objects(done: subprocess.CompletedProcess[str]) -> list[dict[str, Any]]:
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_a_sound_machine_has_a_line_for_each_check_and_ends_with_0(town: ServedChain, router: EmbeddedRouter) -> None:
    words = ("--role", "provider", "--connect", router.endpoint, *PATIENT)
    done = aira("doctor", *words, **town.variables("provider"))

    assert (done.returncode, done.stderr) == (0, "")
    *lines, last = [line for line in done.stdout.splitlines() if line and "->" not in line]
    parts = [LINE.fullmatch(line) for line in lines]
    assert all(parts), done.stdout
    assert [part["name"] for part in parts if part] == [
        *("router", "session", "own write", "denied write", "router clock"),
        *("node", "chain", "chain profile", "node clock", "chain clock", "contracts", "lighthouse", "token"),
        *("keyfile", "ether", "tokens", "other allowances", "stake", "turn", "data folder", "disk space"),
    ]
    assert last.removesuffix(BUSY_DISK) == "all 21 checks passed for the role provider"
    assert "\x1b" not in done.stdout
    assert PASSWORD not in done.stdout


def test_a_warning_ends_with_0_and_is_named_at_the_end(
    town: ServedChain, router: EmbeddedRouter, tmp_path: Path
) -> None:
    password = tmp_path / "password"
    password.write_text(PASSWORD)
    password.chmod(0o644)
    variables = town.variables("robot") | {"AIRA_KEYFILE_PASSWORD_FILE": str(password)}
    done = aira("doctor", "--connect", router.endpoint, *PATIENT, **variables)

    assert done.returncode == 0, done.stdout
    assert re.search(r"checks passed for the role agent; with warnings: keyfile(, data folder)?\n$", done.stdout)
    assert f"-> chmod 600 {password}\n" in done.stdout


def test_a_failure_prints_a_hint_and_the_skipped_checks_and_exits_with_1(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with at_most(30):
        done = aira("doctor", "--role", "operator", "--connect", endpoint)

    assert (done.returncode, done.stderr) == (1, "")
    assert done.stdout.splitlines() == [
        f"FAIL  router        {endpoint}: no router listens there",
        "                    -> start one with `aira router`, or give another address with --connect tcp/HOST:PORT",
        "",
        "skipped because of an earlier failure: session, own write, denied write, router clock",
        "1 of 5 checks failed for the role operator: router",
    ]


def test_json_has_one_object_per_check_with_four_fields(town: ServedChain, router: EmbeddedRouter) -> None:
    variables = town.variables("robot") | {"AIRA_CONNECT": router.endpoint}
    done = aira("doctor", "--json", *PATIENT, **variables)
    found = objects(done)

    assert (done.returncode, done.stderr) == (0, "")
    assert all(list(each) == ["name", "ok", "found", "do", "code"] for each in found)
    assert all(each["ok"] is True and each["found"] for each in found)
    assert {each["do"] for each in found if each["code"] != "disk-slow"} == {""}


def test_json_of_a_failure_has_a_hint(town: ServedChain, router: EmbeddedRouter) -> None:
    words = ("--json", "--role", "provider", "--connect", router.endpoint, *PATIENT)
    done = aira("doctor", *words, **town.variables("stranger"))

    assert done.returncode == 1
    (failed,) = [each for each in objects(done) if not each["ok"]]
    assert (failed["name"], failed["code"]) == ("stake", "no-stake")
    assert "aira lighthouse join" in failed["do"]


def test_neither_the_wrong_nor_the_right_password_is_printed(town: ServedChain, tmp_path: Path) -> None:
    (tmp_path / "password").write_text("open barley\n")
    variables = town.variables("robot") | {"AIRA_KEYFILE_PASSWORD_FILE": str(tmp_path / "password")}
    done = aira("doctor", "--json", "--role", "agent", **variables)

    (keyfile,) = [each for each in objects(done) if each["name"] == "keyfile"]
    assert not keyfile["ok"]
    assert not any(word in done.stdout + done.stderr for word in ("barley", PASSWORD))


def test_a_key_in_the_address_of_a_node_is_not_shown() -> None:
    port = free_port()
    done = aira("doctor", "--role", "agent", "--web3-http-provider", f"http://me:sesame@127.0.0.1:{port}/v3/0xc0ffee")

    assert f"http://127.0.0.1:{port}/…" in done.stdout
    assert not any(word in done.stdout + done.stderr for word in ("sesame", "c0ffee"))


def test_unreadable_settings_end_with_2() -> None:
    done = aira("doctor", "--generation", "4")

    assert done.returncode == 2
    assert done.stdout == ""
    assert "generation" in done.stderr


def test_a_device_without_its_agent_ends_with_2() -> None:
    done = aira("doctor", "--device", "lamp")

    assert (done.returncode, done.stdout) == (2, "")
    assert "--agent" in done.stderr


def test_a_server_that_accepts_and_never_answers_fails_at_the_timeout() -> None:

    with socket.create_server(("127.0.0.1", 0)) as silent, at_most(40):
        port = silent.getsockname()[1]
        done = aira(
            *("doctor", "--timeout", "3", "--json", "--connect", f"tcp/127.0.0.1:{port}"),
            *("--web3-http-provider", f"http://127.0.0.1:{port}"),
        )

    failed = [each["name"] for each in objects(done) if not each["ok"]]
    assert done.returncode == 1
    assert failed == ["session", "node"]


def test_the_default_role_is_that_of_the_certificate(tmp_path: Path) -> None:
    site = Site(tmp_path)
    folder = site.enlist(Member(name="desk", address=ARM, roles=("operator",)))
    settings = settings_of(site.client(folder))
    files = ("--tls-ca", settings.tls_ca, "--tls-certificate", settings.tls_certificate, "--tls-key", settings.tls_key)
    with site.open_router("wheel"):
        done = aira("doctor", "--connect", site.endpoint, *PATIENT, *files)

    assert done.returncode == 0, done.stdout
    assert "for the role operator" in done.stdout
    assert "denied as expected: " in done.stdout


def shown(*roles: str) -> CertificateInfo:
    """The identity of a certificate with these roles."""
    return CertificateInfo(address=ARM, name="somebody", roles=roles, until=0.0)


def test_the_role_follows_from_the_settings() -> None:
    assert DoctorContext(settings=Settings()).role == "agent"
    assert DoctorContext(settings=Settings(roster="roster.toml")).role == "router"
    assert DoctorContext(settings=Settings(), serial=SerialSettings(port="/dev/ttyACM0")).role == "edge"
    assert DoctorContext(settings=Settings(), identity=shown("watcher")).role == "operator"
    assert DoctorContext(settings=Settings(), identity=shown("provider")).role == "provider"
    assert (
        DoctorContext(settings=Settings(roster="roster.toml"), requested_role="person", identity=shown("edge")).role
        == "person"
    )


def test_nothing_is_left_behind(town: ServedChain, router: EmbeddedRouter, tmp_path: Path) -> None:
    before = sorted(os.listdir(tmp_path))
    variables = town.variables("robot") | {"AIRA_DATA_DIR": str(tmp_path / "state")}
    done = aira("doctor", "--connect", router.endpoint, *PATIENT, **variables)

    assert done.returncode == 0, done.stdout
    assert sorted(os.listdir(tmp_path)) == before


SMALL = """
import sys
for name in ("web3", "eth_account", "eth_abi", "aiohttp", "cryptography", "prometheus_client"):
    sys.modules[name] = None
from mesh.__main__ import main
main()
"""
"""The command line on an edge machine, which has none of these."""


def test_an_edge_machine_is_checked_without_the_packages_of_other_roles(tmp_path: Path) -> None:
    site = Site(tmp_path)
    folder = site.enlist(Member(name="lamp", address=ARM, roles=("edge",)))
    settings = settings_of(site.client(folder))
    files = ("--tls-ca", settings.tls_ca, "--tls-certificate", settings.tls_certificate, "--tls-key", settings.tls_key)
    with site.open_router("wheel"):
        done = run(
            *(sys.executable, "-c", SMALL, "doctor", "--json", "--tty", "/dev/null", *PATIENT),
            *("--connect", site.endpoint, *files),
        )

    found = {each["name"]: each for each in objects(done)}
    assert done.stderr == ""
    assert [name for name, each in found.items() if not each["ok"]] == ["serial port"]
    assert found["certificate"]["found"].startswith(f"lamp, edge, {ARM}: valid")
    assert found["denied write"]["code"] == "denied"
    assert "its agent's jobs" in found["denied write"]["found"]


def test_a_missing_package_is_reported() -> None:
    done = run(sys.executable, "-c", SMALL, "doctor", "--json", "--role", "agent")

    (node,) = [each for each in objects(done) if each["name"] == "node"]
    assert node["code"] == "package-missing"
    assert "pip install '.[chain" in node["do"]
