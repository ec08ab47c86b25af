"""Orders of programs that wait for a person's yes, on the page: who sees and answers them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from bridges.web._access import WebOptions
from mesh.errors import ConfigurationError
from mesh.signer.client import SignerClient
from mesh.signer.service import Signer
from tests.bridges.web.test_web_control import OPERATOR, log_in
from tests.support.market import MODEL

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.market import Place

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


POLICY = """\
[budget]
per_job = "5 XRT"
per_hour = "20 XRT"
per_day = "50 XRT"
jobs_at_a_time = 2
[consent]
always = true
[[allow]]
models = ["*"]
robots = ["*"]
[allow.topics."/blink"]
"""


async def test_an_operator_answers_an_order_once(place: Place, serve: Any, tmp_path: Path) -> None:
    policy = tmp_path / "policy.toml"
    policy.write_text(POLICY)
    policy.chmod(0o600)
    account, chain = place.market.accounts["person"], place.chains["person"]
    async with (
        Signer(place.settings("signer"), policy, account=account, chain=chain) as signer,
        SignerClient(signer.door) as program,
        serve(operator_token=OPERATOR, signer=str(signer.owner)) as browser,
    ):
        order: dict[str, Any] = {"model": MODEL, "messages": [("/blink", None)], "cost": "1 XRT"}
        jobs = [await program.order(**order, idempotency_key=key) for key in ("one", "two")]
        assert [job.state for job in jobs] == ["needs-consent", "needs-consent"]
        await log_in(browser)
        listed = (await browser.get("consents"))["consents"]
        assert {one["job_id"] for one in listed} == {job.job_id for job in jobs}
        assert listed[0]["cost"]["text"] == "1 XRT"
        allowed, denied = listed
        answered = await browser.post(f"consents/{allowed['id']}", {"allow": True})
        assert answered["job"] == allowed["job_id"]
        assert answered["state"] != "needs-consent"
        assert (await browser.post(f"consents/{denied['id']}", {"allow": False}))["state"] == "denied"
        again = await browser.post(f"consents/{denied['id']}", {"allow": True}, status=502)
        assert again["error"]["code"] == "consent-used"
        assert (await browser.get("consents"))["consents"] == []
