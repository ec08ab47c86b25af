"""How a server waits for missing files and for its dependencies."""

from __future__ import annotations

import os
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING

import pytest

from mesh.base.retry import RetryPolicy
from mesh.chain import Account
from mesh.errors import ConfigurationError, RemoteError
from mesh.role.running import file_delays, open_when_ready
from mesh.settings import Settings

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

NOBODY = 65_534
QUICK = RetryPolicy(initial=0.001, ceiling=0.001)


def settings(folder: Path, *, connect_timeout: float = -1) -> Settings:
    files = {"keyfile": str(folder / "account.json"), "keyfile_password_file": str(folder / "password")}
    return Settings(connect_timeout=connect_timeout, **files)  # type: ignore[arg-type]


def test_it_waits_until_all_files_exist(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    waiting = file_delays(settings(tmp_path))
    assert next(waiting, None) is not None
    (tmp_path / "account.json").write_text("{}")
    assert next(waiting, None) is not None
    (tmp_path / "password").write_text("secret\n")
    assert next(waiting, None) is None
    outage, recovered = caplog.records
    assert (outage.event, outage.facts["code"]) == ("files-outage", "files-missing")  # type: ignore[attr-defined]
    for name in ("account.json", "password"):
        assert str(tmp_path / name) in outage.getMessage()
    assert recovered.event == "files-recovered"  # type: ignore[attr-defined]


def test_with_a_time_limit_it_does_not_wait_for_files(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert list(file_delays(settings(tmp_path, connect_timeout=10))) == []
    assert caplog.messages == []


def test_a_folder_in_place_of_a_file_counts_as_present(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "account.json").mkdir()
    (tmp_path / "password").write_text("secret\n")
    assert list(file_delays(settings(tmp_path))) == []
    assert caplog.messages == []
    with pytest.raises(ConfigurationError):
        Account.from_keyfile(tmp_path / "account.json", tmp_path / "password")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root makes files that another user may not read")
def test_files_of_another_user_are_logged_with_a_hint(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name in ("account.json", "password"):
        (tmp_path / name).touch(mode=0o600)
    waiting = file_delays(settings(tmp_path))
    os.seteuid(NOBODY)
    try:
        assert next(waiting, None) is not None
    finally:
        os.seteuid(0)
    assert next(waiting, None) is None
    (outage,) = caplog.records
    assert (outage.event, outage.facts["code"]) == ("files-outage", "files-not-readable")  # type: ignore[attr-defined]
    assert f"chown -R {NOBODY}" in outage.getMessage()


class Late:
    """Something that can't be opened until its third attempt."""

    def __init__(self) -> None:
        self.attempts = 0

    @asynccontextmanager
    async def open(self) -> AsyncIterator[int]:
        self.attempts += 1
        if self.attempts < 3:
            raise RemoteError("not here yet")
        yield self.attempts


async def test_a_server_opens_when_it_can_and_logs_once_that_it_waits(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    late, reasons = Late(), list[str]()
    async with AsyncExitStack() as stack:
        wanted = Settings(connect_timeout=-1)
        opened = await open_when_ready(stack, wanted, late.open, role="agent", on_wait=reasons.append, retry=QUICK)
    assert (opened, reasons) == (3, ["not here yet"] * 2)
    events = [record.event for record in caplog.records]  # type: ignore[attr-defined]
    assert events == ["startup-outage", "startup-recovered"]


async def test_with_a_time_limit_the_first_failure_is_raised() -> None:
    late = Late()
    async with AsyncExitStack() as stack:
        with pytest.raises(RemoteError):
            await open_when_ready(stack, Settings(connect_timeout=10), late.open, role="agent", retry=QUICK)
    assert late.attempts == 1
