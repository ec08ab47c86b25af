"""Orders of programs that wait for a person's yes, on the page: who sees and answers them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from bridges.web.access import WebOptions
from mesh.errors import ConfigurationError
from tests.bridges.web.test_web_control import OPERATOR, log_in

if TYPE_CHECKING:
    from pathlib import Path

CONSENT = "consent-0123456789abcdef"


async def test_only_operators_who_logged_in_see_and_answer_them(serve: Any, tmp_path: Path) -> None:
    """With the account of the server everybody is an operator: the programs that ask are not to answer themselves."""
    options = {"operator_token": OPERATOR, "signer": str(tmp_path / "owner.sock")}
    async with serve("person", **options) as browser:
        assert (await browser.get("market"))["asksForConsent"]
        assert (await browser.get("consents", status=403))["error"]["code"] == "operators-only"
        refused = await browser.post(f"consents/{CONSENT}", {"allow": True}, status=403)
        assert refused["error"]["code"] == "operators-only"
        await log_in(browser)
        assert (await browser.get("consents", status=502))["error"]["code"] == "signer-unavailable"


async def test_without_a_signer_there_are_none(serve: Any) -> None:
    async with serve("person") as browser:
        assert not (await browser.get("market"))["asksForConsent"]
        assert (await browser.get("consents", status=404))["error"]["code"] == "page-not-found"


def test_a_signer_needs_operators_who_log_in() -> None:
    with pytest.raises(ConfigurationError) as caught:
        WebOptions(signer="owner.sock").check()
    assert "--operator-token-file" in caught.value.hint
