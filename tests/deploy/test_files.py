"""The compose files, the Dockerfile and the locks of the images, read without a container engine."""

from __future__ import annotations

import json
import re
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from mesh.settings import OPTIONS
from tests.support.peers import require

ROOT = Path(__file__).parents[2]
ONE_SITE, TWO_SITES = ROOT / "docker-compose.yml", ROOT / "docker-compose.two-sites.yml"
STAGE = re.compile(r"^FROM (?P<base>\S+)(?: AS (?P<name>\S+))?$", re.MULTILINE)
VARIABLE = re.compile(r"\$\{(\w+):-([^}]*)\}")
FOREIGN = {"ipfs"}
"""Services whose image is not ours."""


@cache
def compose(file: Path) -> dict[str, Any]:
    """The contents of a compose file, with its aliases and merges resolved."""
    require("docker-compose")  # which is in Python, and so brings a reader of YAML for that of Debian
    read = "import json, sys, yaml; print(json.dumps(yaml.safe_load(open(sys.argv[1]))))"
    done = subprocess.run(
        ["/usr/bin/python3", "-c", read, str(file)], capture_output=True, text=True, timeout=60, check=True
    )
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def services() -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = compose(ONE_SITE)["services"]
    assert len(found) > 8
    return found


@cache
def stages() -> dict[str, tuple[str, str]]:
    """The stages of the Dockerfile: their base images and their lines."""
    text = (ROOT / "Dockerfile").read_text()
    parts = STAGE.split(text)
    return {name: (base, lines) for base, name, lines in zip(parts[1::3], parts[2::3], parts[3::3], strict=True)}


def versions(lock: str) -> dict[str, set[str]]:
    """The packages of a lock (`name==version`), each with its hashes."""
    text = (ROOT / "requirements" / lock).read_text().replace("\\\n", " ")
    hashes = re.compile(r"--hash=(\S+)")
    return {re.split(" ;| --hash", line)[0].strip(): set(hashes.findall(line)) for line in text.splitlines()}


@pytest.mark.parametrize("lock", ["edge.txt", "server.txt"])
def test_the_images_use_the_tested_versions(lock: str) -> None:
    tested, used = versions("lock.txt"), versions(lock)
    assert len(used) > 10
    for requirement, hashes in used.items():
        assert hashes
        assert hashes <= tested[requirement], requirement


def test_the_edge_image_installs_no_chain_client() -> None:
    names = {requirement.split("==")[0] for requirement in versions("edge.txt")}
    assert {"eclipse-zenoh", "pyserial"} <= names
    assert not names & {"web3", "eth-account", "aiohttp", "cryptography", "pytest"}


@pytest.mark.parametrize("target", ["edge", "server", "chain"])
def test_no_image_runs_as_root(target: str) -> None:
    users: list[str] = []
    while target in stages():
        target, lines = stages()[target]
        users = re.findall(r"^USER (\S+)$", lines, re.MULTILINE) + users
    assert users[-1] == "10001:10001"


def test_each_service_uses_an_image_of_the_dockerfile() -> None:
    for name, service in services().items():
        if name not in FOREIGN:
            assert service["build"]["target"] in stages(), name
            assert f"-{service['build']['target']}:" in service["image"], name


def test_services_have_minimal_rights() -> None:
    for name, service in services().items():
        assert service["read_only"] is True, name
        assert service["cap_drop"] == ["ALL"], name
        assert service["security_opt"] == ["no-new-privileges:true"], name
        assert service["mem_limit"], name
        assert not service.keys() & {"privileged", "cap_add", "network_mode", "pid", "container_name"}, name


def test_a_variable_of_a_service_is_a_setting_and_names_files_only() -> None:
    for name, service in services().items():
        for variable, value in service.get("environment", {}).items():
            if variable.startswith("AIRA_"):
                assert variable.removeprefix("AIRA_").lower() in OPTIONS, f"{name}: {variable}"
            if re.search("KEY|PASSWORD|SECRET|TOKEN_|AUTHORIZATION", variable):
                assert re.fullmatch(r"/secrets/[a-z.]+", value), f"{name}: {variable}"


def test_a_service_gets_only_its_own_secrets_and_read_only() -> None:
    seen: dict[str, str] = {}
    for name, service in services().items():
        for mount in service.get("volumes", []):
            if "secrets" in mount and name != "setup":
                assert mount.endswith("-secrets}:/secrets:ro"), f"{name}: {mount}"
                assert seen.setdefault(mount, name) == name
    assert len(seen) == 9


def test_no_port_is_open_to_other_machines_by_default() -> None:
    for name, service in services().items():
        for port in service.get("ports", []):
            assert re.fullmatch(r"\$\{MESH_\w+_PORT:-127\.0\.0\.1::\d+\}", port), f"{name}: {port}"


def test_the_page_is_served_by_tls_to_those_who_log_in() -> None:
    words = services()["page"]["command"]
    for option in ("--certificate", "--key", "--token-file"):
        (value,) = [word.partition("=")[2] for word in words if word.startswith(f"{option}=")]
        assert value.startswith("/secrets/"), option


def test_no_volume_name_is_a_prefix_of_another() -> None:
    """Podman takes such a name for the other one, and then does not remove it."""
    for file in (ONE_SITE, TWO_SITES):
        names = list(compose(file)["volumes"])
        assert not [(one, two) for one in names for two in names if one != two and two.startswith(one)]


def test_every_volume_that_a_service_mounts_is_defined() -> None:
    """Also in the second file, whose services have the volumes of those they extend."""
    for file in (ONE_SITE, TWO_SITES):
        defined = compose(file)["volumes"]
        for name, service in compose(file)["services"].items():
            base = services()[service["extends"]["service"]] if "extends" in service else {}
            for mount in service.get("volumes", []) + base.get("volumes", []):
                source = VARIABLE.sub(r"\2", mount).partition(":")[0]
                assert source in defined or source.startswith("."), f"{file.name}: {name}: {mount}"


def test_the_second_file_builds_on_services_of_the_first() -> None:
    for name, service in compose(TWO_SITES)["services"].items():
        assert service["extends"]["file"] == ONE_SITE.name, name
        assert service["extends"]["service"] in services(), name
        assert set(service["networks"]) <= {"north", "south", "wan"}, name


def test_the_example_of_env_has_the_default_of_every_variable() -> None:
    used = dict(VARIABLE.findall(ONE_SITE.read_text()))
    documented = dict(re.findall(r"^#([A-Z]\w*)=(.*)$", (ROOT / ".env.example").read_text(), re.MULTILINE))
    assert len(used) > 30
    assert documented == used


def test_every_variable_of_the_compose_file_is_in_the_example_of_env() -> None:
    example = (ROOT / ".env.example").read_text()
    names = {part.split(":-")[0] for part in ONE_SITE.read_text().split("${")[1:]}
    assert len(names) > 20
    assert [name for name in sorted(names) if f"#{name}=" not in example] == []


def test_a_default_is_the_same_wherever_a_variable_is_used() -> None:
    found: dict[str, str] = {}
    for variable, default in VARIABLE.findall(ONE_SITE.read_text()):
        assert found.setdefault(variable, default) == default, variable


@pytest.mark.parametrize("script", sorted((ROOT / "deploy" / "compose").glob("*.sh")), ids=lambda script: script.name)
def test_the_scripts_of_the_services_run_in_any_posix_shell(script: Path) -> None:
    assert script.read_text().startswith("#!/bin/sh\n")
    subprocess.run(["sh", "-n", script], timeout=60, check=True)
