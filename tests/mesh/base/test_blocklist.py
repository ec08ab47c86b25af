"""The file of signers whose messages are dropped."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest
from msgspec.structs import replace

from mesh.base.fresh_file import CHECK_INTERVAL, Blocklist, blocklist_at
from mesh.errors import ConfigurationError
from mesh.network import MarketRules, MessageValidator, message_key
from schemas import Demand, Signer, encode
from tests.support.clocks import SECOND, SetClock
from tests.support.network.validating import check_payload
from tests.support.schemas.samples import DEMAND

if TYPE_CHECKING:
    from pathlib import Path

MALLORY = Signer(b"\7" * 32)
LIGHTHOUSE = "airalab.lighthouse.3.robonomics.eth"


def replace_file(path: Path, text: str) -> None:
    """Replace a file as an editor does."""
    new = path.with_suffix(".new")
    new.write_text(text)
    os.replace(new, path)


def test_addresses_are_blocked_while_the_file_names_them(tmp_path: Path) -> None:
    path, clock = tmp_path / "blocked.txt", SetClock()
    path.write_text(f"# nobody likes garbage\n\n{MALLORY.address.lower()}  # since May\n")
    blocked = Blocklist(path, clock=clock)
    assert MALLORY.address in blocked
    replace_file(path, "")
    assert MALLORY.address in blocked  # the file is looked at once in a while
    clock.pass_by(int(CHECK_INTERVAL * SECOND))
    assert MALLORY.address not in blocked


@pytest.mark.parametrize("broken", ["not an address\n", "\udcff", "x" * 5_000_000])
def test_a_change_that_can_not_be_read_changes_nothing(tmp_path: Path, broken: str) -> None:
    path, clock = tmp_path / "blocked.txt", SetClock()
    path.write_text(MALLORY.address)
    blocked = Blocklist(path, clock=clock)
    path.write_bytes(broken.encode(errors="surrogateescape"))
    clock.pass_by(int(CHECK_INTERVAL * SECOND))
    assert MALLORY.address in blocked
    path.unlink()
    clock.pass_by(int(CHECK_INTERVAL * SECOND))
    assert MALLORY.address in blocked
    with pytest.raises(ConfigurationError):
        blocklist_at(str(path))


def test_nobody_is_blocked_without_a_file() -> None:
    assert MALLORY.address not in blocklist_at("")


def test_messages_of_a_blocked_signer_are_rejected(tmp_path: Path) -> None:
    path, clock = tmp_path / "blocked.txt", SetClock()
    path.write_text("")
    validator = MessageValidator(Demand, MarketRules(LIGHTHOUSE, blocked=Blocklist(path, clock=clock)))
    first, second = (MALLORY.sign(replace(DEMAND, nonce=f"{number}" * 64)) for number in (1, 2))
    assert check_payload(validator, message_key(LIGHTHOUSE, first), encode(first)) is not None
    path.write_text(MALLORY.address)
    clock.pass_by(int(CHECK_INTERVAL * SECOND))
    assert check_payload(validator, message_key(LIGHTHOUSE, second), encode(second)) is None
    assert validator.statistics(received=2, dropped=0).invalid == {"blocked": 1}
