"""The systemd units: valid for systemd, with minimal rights, and with commands that exist."""

from __future__ import annotations

import os
import pwd
import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest
from click.testing import CliRunner

from mesh.cli import main
from mesh.settings import OPTIONS
from mesh.settings.groups import PREFIX
from tests.support.peers import require

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT: Final = Path(__file__).parents[2]
UNITS: Final = ROOT / "deploy" / "systemd"
SERVICES: Final = sorted(path.name.replace("@.", "@here.") for path in UNITS.glob("*.service"))
TIMERS: Final = sorted(path.name for path in UNITS.glob("*.timer"))
MOST_EXPOSED: Final = 2.0
"""On systemd's scale from 0 to 10; the rest is mostly the network, which these services need."""


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The root of a machine on which the units are installed."""
    analyze = require("systemd-analyze")
    root = tmp_path_factory.mktemp("machine")
    shutil.copytree("/usr/lib/systemd/system", root / "usr/lib/systemd/system", symlinks=True)
    for program in ("opt/aira/bin/aira", "opt/aira/bin/python", "bin/sh"):
        (root / program).parent.mkdir(parents=True, exist_ok=True)
        (root / program).symlink_to("/bin/true")
    (root / "bin/true").write_bytes(Path("/bin/true").read_bytes())
    (root / "bin/true").chmod(0o755)
    done = subprocess.run([UNITS / "install"], env={**os.environ, "DESTDIR": str(root)}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert analyze.exists()
    return root


def analyze(machine: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [str(require("systemd-analyze")), f"--root={machine}", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize("unit", SERVICES + TIMERS)
def test_systemd_finds_nothing_wrong(machine: Path, unit: str) -> None:
    done = analyze(machine, "verify", "--man=no", unit)
    said = [line for line in done.stderr.splitlines() if "aira" in line]
    assert (done.returncode, said) == (0, [])


def test_systemd_reports_an_unknown_directive(machine: Path) -> None:
    """The tests above rely on this."""
    unit = machine / "etc/systemd/system/aira-wrong.service"
    unit.write_text((UNITS / "aira-router.service").read_text().replace("MemoryMax", "MemoryMaximum"))
    try:
        assert "'MemoryMaximum'" in analyze(machine, "verify", "--man=no", unit.name).stderr
    finally:
        unit.unlink()


@pytest.mark.parametrize("unit", SERVICES)
def test_services_are_sandboxed(machine: Path, unit: str) -> None:
    done = analyze(machine, "security", "--offline=true", "--no-pager", f"--threshold={MOST_EXPOSED * 10:.0f}", unit)
    assert done.returncode == 0, done.stdout
    found = re.search(r"Overall exposure level for \S+: ([\d.]+)", done.stdout)
    assert found is not None
    assert float(found[1]) <= MOST_EXPOSED


def test_only_a_device_s_service_sees_devices(machine: Path) -> None:
    for unit in SERVICES:
        said = analyze(machine, "security", "--offline=true", "--no-pager", unit).stdout
        (line,) = [line for line in said.splitlines() if " PrivateDevices= " in line]
        assert line.startswith("✗") == unit.startswith("aira-edge"), unit


def lines(text: str) -> Iterator[str]:
    """The settings of a unit, each on one line."""
    for line in text.replace("\\\n", " ").splitlines():
        if line and line[0] not in "#[":
            yield line


def units() -> list[Path]:
    return [*UNITS.glob("*.service"), *UNITS.glob("*.service.d/*.conf")]


@pytest.mark.parametrize("unit", [path.name for path in UNITS.glob("*.service")])
def test_the_command_of_a_unit_exists(unit: str) -> None:
    """With `--help` behind it: its words and options are known."""
    (start,) = [line for line in lines((UNITS / unit).read_text()) if line.startswith("ExecStart=")]
    words = shlex.split(start.partition("=")[2])
    if words[0] == "/bin/sh":
        words = shlex.split(words[2].removeprefix("exec "))
    if words[0] == "/opt/aira/bin/python":
        return
    assert words[0] == "/opt/aira/bin/aira"
    options = {word for word in words if word.startswith("--")}
    command = [word for word in words[1:] if re.fullmatch("[a-z]+", word)]
    done = CliRunner().invoke(main, [*command, "--help"])
    assert done.exit_code == 0, done.output
    assert all(re.search(rf"{option}\b", done.output) for option in options)


def test_variables_of_units_are_options_and_hold_no_secrets() -> None:
    """An unknown one would stop the service; a secret would be shown by `systemctl show`."""
    seen = 0
    for path in units():
        for line in lines(path.read_text()):
            if not line.startswith("Environment="):
                continue
            for variable in shlex.split(line.partition("=")[2]):
                name, _, value = variable.partition("=")
                if not name.startswith(PREFIX):
                    continue
                seen += 1
                option = name.removeprefix(PREFIX).lower()
                assert option in OPTIONS or name == "AIRA_CONFIG"
                if option in ("tls_key", "keyfile", "keyfile_password_file"):
                    assert value.startswith("%d/"), f"{name} of {path.name} is no credential"
    assert seen > 10


@pytest.mark.parametrize("unit", [path.name for path in UNITS.glob("*.service")])
def test_each_secret_that_a_unit_names_is_a_credential_of_it(unit: str) -> None:
    text = (UNITS / unit).read_text()
    named = set(re.findall(r"%d/([a-z-]+)", text))
    loaded = set(re.findall(r"^LoadCredential=([a-z.-]+):/etc/aira/\S+$", text, re.MULTILINE))
    assert loaded, "a service has an identity at least"
    assert named == loaded or unit == "aira-identity-renew.service"


@pytest.mark.parametrize("unit", [path.name for path in UNITS.glob("*.service")])
def test_a_unit_does_not_contradict_the_common_file(unit: str) -> None:
    """A file in aira-.service.d is read after the unit, and wins: settings that differ are in a separate file."""
    common = {line.partition("=")[0] for line in lines((UNITS / "aira-.service.d/10-every-service.conf").read_text())}
    own = {line.partition("=")[0] for line in lines((UNITS / unit).read_text())}
    assert own & common <= {"Environment", "After", "Wants"}


def test_a_renewal_that_fails_waits_for_its_timer() -> None:
    """The common file has services started again after some seconds, for ever."""
    common, own = (UNITS / folder for folder in ("aira-.service.d", "aira-identity-renew.service.d"))
    read = [line for path in (*sorted(common.iterdir()), *sorted(own.iterdir())) for line in lines(path.read_text())]
    said = [line for line in read if line.startswith("Restart=")]
    assert len(said) == 2
    assert said[-1] == "Restart=no"


@pytest.mark.skipif(os.geteuid() != 0, reason="files are given to another user")
def test_files_created_by_root_belong_to_the_service(tmp_path: Path) -> None:
    state, elsewhere = tmp_path / "lib/arm", tmp_path / "elsewhere"
    state.mkdir(parents=True)
    elsewhere.touch()
    (state / "link").symlink_to(elsewhere)
    program = tmp_path / "aira"
    program.write_text('#!/bin/sh\necho x > "$AIRA_DATA_DIR/made"\nexit 3\n')
    program.chmod(0o755)
    changes = {"/opt/aira/bin/aira": str(program), "/var/lib/aira": str(tmp_path / "lib"), "aira:aira": "daemon:daemon"}
    script = (UNITS / "aira-as").read_text()
    for text, here in changes.items():
        assert text in script
        script = script.replace(text, here)

    done = subprocess.run(["sh", "-c", script, "aira-as", "arm", "state", "restore"], capture_output=True, text=True)

    assert (done.returncode, done.stderr) == (3, "")
    made = (state / "made").stat()
    assert made.st_uid == pwd.getpwnam("daemon").pw_uid
    assert made.st_mode & 0o777 == 0o600
    assert elsewhere.stat().st_uid == 0


def test_the_installer_overwrites_no_file_of_the_user(machine: Path) -> None:
    rules = machine / "etc/udev/rules.d/60-aira-devices.rules"
    rules.write_text("my own")
    subprocess.run([UNITS / "install"], env={**os.environ, "DESTDIR": str(machine)}, check=True, capture_output=True)
    assert rules.read_text() == "my own"
    assert (machine / "etc/aira/members").is_dir()


def test_sysusers_creates_the_user_of_the_units(tmp_path: Path) -> None:
    sysusers = shutil.which("systemd-sysusers")
    if sysusers is None:
        require("systemd-analyze")
        pytest.fail("systemd-sysusers comes with systemd")
    (tmp_path / "etc").mkdir()
    (tmp_path / "etc/group").write_text("dialout:x:20:\n")
    (tmp_path / "etc/passwd").write_text("")
    subprocess.run([sysusers, f"--root={tmp_path}", str(UNITS / "aira.sysusers")], check=True, capture_output=True)
    assert re.search(r"^aira:x:\d+:\d+:AIRA mesh:/var/lib/aira:", (tmp_path / "etc/passwd").read_text(), re.MULTILINE)
    assert "dialout:x:20:aira" in (tmp_path / "etc/group").read_text()
