"""A real Chromium, and in it a wallet that announces itself by EIP-6963 and signs with a test key.

The wallet's calls wait in the page until the test answers them: `until` does, so a test sees each call.
"""

from __future__ import annotations

import base64
import json
import time
import urllib.request
from typing import TYPE_CHECKING, Any, Final, Self

from eth_account import Account
from eth_account.messages import encode_defunct, encode_typed_data
from selenium import webdriver
from selenium.common.exceptions import NoSuchElementException, StaleElementReferenceException, WebDriverException
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from tests.support.peers import require
from tests.support.waiting import wait_until

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from selenium.webdriver.remote.webelement import WebElement

PATIENCE: Final = 120.0
"""Seconds until what a test waits for must have come, on a busy machine."""
DESKTOP: Final = (1280, 900)
PHONE: Final = (390, 844)

WALLET: Final = """
(() => {
  const waiting = new Map(), listeners = {};
  let last = 0;
  window.testWallet = {
    calls: [],
    answer(id, error, value) {
      const { resolve, reject } = waiting.get(id);
      waiting.delete(id);
      error ? reject(error) : resolve(value);
    },
    emit(event, value) { for (const one of listeners[event] ?? []) one(value); },
  };
  const provider = {
    request: ({ method, params }) => new Promise((resolve, reject) => {
      waiting.set(++last, { resolve, reject });
      window.testWallet.calls.push({ id: last, method, params: params ?? [] });
    }),
    on: (event, listener) => { (listeners[event] ??= []).push(listener); },
  };
  const info = { uuid: "6e1d5b0e-0000-4000-8000-000000000001", name: "Test wallet", icon: "", rdns: "test.wallet" };
  const announce = () => window.dispatchEvent(
    new CustomEvent("eip6963:announceProvider", { detail: Object.freeze({ info, provider }) }));
  window.addEventListener("eip6963:requestProvider", announce);
  announce();
})();
"""


class Refused(Exception):
    """What a wallet answers when it does not do what a page asks."""

    def __init__(self, code: int, message: str) -> None:
        super().__init__(message)
        self.code = code


class Wallet:
    """The keys, and what they do: signs everything, unless `rejects` has the method."""

    def __init__(self, key: bytes, node: str) -> None:
        self.account = Account.from_key(key)
        self.address: str = self.account.address
        self.node = node
        self.chain_id = int(self.rpc("eth_chainId"), 16)
        self.rejects: set[str] = set()
        self.calls: list[str] = []
        self.typed_data: list[dict[str, Any]] = []
        """What it has signed by EIP-712."""

    def rpc(self, method: str, *params: Any) -> Any:
        """The node's answer."""
        body = json.dumps({"jsonrpc": "2.0", "id": 1, "method": method, "params": params}).encode()
        request = urllib.request.Request(self.node, body, {"Content-Type": "application/json"})
        with urllib.request.urlopen(request, timeout=30) as response:
            answer = json.load(response)
        if "error" in answer:
            raise Refused(-32000, str(answer["error"].get("message")))
        return answer["result"]

    def answer(self, method: str, params: list[Any]) -> Any:
        """What the wallet answers a page. Raises `Refused`."""
        self.calls.append(method)
        if method in self.rejects:
            raise Refused(4001, "User rejected the request.")
        if method in ("eth_requestAccounts", "eth_accounts"):
            return [self.address.lower()]
        if method == "eth_chainId":
            return hex(self.chain_id)
        if method == "wallet_switchEthereumChain":
            self.chain_id = int(params[0]["chainId"], 16)
            return None
        if method == "personal_sign":
            return "0x" + self.account.sign_message(encode_defunct(hexstr=params[0])).signature.hex().removeprefix("0x")
        if method == "eth_signTypedData_v4":
            self.typed_data.append(json.loads(params[1]))
            signable = encode_typed_data(full_message=self.typed_data[-1])
            return "0x" + self.account.sign_message(signable).signature.hex().removeprefix("0x")
        if method == "eth_sendTransaction":
            return self._send(params[0])
        return self.rpc(method, *params)

    def give(self, address: str, *, wei: int = 0, token: str = "", units: int = 0) -> None:
        """Send an account ether, or units of a token; it has them when this returns."""
        if token:
            self.transact({"to": token, "data": f"0xa9059cbb{int(address, 16):064x}{units:064x}"})
        else:
            self.transact({"to": address, "data": "0x", "value": wei})

    def transact(self, call: dict[str, Any]) -> None:
        """Send a transaction, and wait until it is in a block."""
        sent = self._send(call)
        wait_until(lambda: self.rpc("eth_getTransactionReceipt", sent), what="the transaction's receipt")

    def _send(self, call: dict[str, Any]) -> Any:
        transaction = {
            "to": call["to"],
            "data": call["data"],
            "value": call.get("value", 0),
            "nonce": int(self.rpc("eth_getTransactionCount", self.address, "latest"), 16),
            "chainId": int(self.rpc("eth_chainId"), 16),
            "gas": 2_000_000,
            "gasPrice": 2 * int(self.rpc("eth_gasPrice"), 16),
        }
        raw = self.account.sign_transaction(transaction).raw_transaction.hex().removeprefix("0x")
        return self.rpc("eth_sendRawTransaction", "0x" + raw)


class Browser:
    """`with Browser(url, wallet) as browser`."""

    def __init__(
        self, url: str, wallet: Wallet | None = None, *, size: tuple[int, int] = DESKTOP, dark: bool = False
    ) -> None:
        options = webdriver.ChromeOptions()
        options.binary_location = str(require("chromium"))
        for word in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars"):
            options.add_argument(word)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
        self.driver = webdriver.Chrome(options=options, service=Service(str(require("chromedriver"))))
        self.url, self.wallet = url, wallet
        self.resize(size)
        self.set_dark(dark)
        self.start_wallet()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.driver.quit()

    def start_wallet(self) -> None:
        """Have the wallet in each document that this tab opens from now on."""
        if self.wallet is not None:
            self.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": WALLET})

    def resize(self, size: tuple[int, int]) -> None:
        """Show the page as a screen of this size does."""
        metrics = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": size[0] < 600}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)

    def set_dark(self, dark: bool) -> None:
        """Prefer dark or light colours."""
        feature = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})

    def go(self, route: str = "") -> None:
        """Open a page of the page, as a link does."""
        self.driver.get(f"{self.url}/#/{route}")

    def serve_wallet(self) -> None:
        """Answer the wallet's calls that wait."""
        if self.wallet is None:
            return
        for call in self.driver.execute_script("return window.testWallet?.calls.splice(0) ?? []"):
            error, value = None, None
            try:
                value = self.wallet.answer(call["method"], call["params"])
            except Refused as refused:
                error = {"code": refused.code, "message": str(refused)}
            self.driver.execute_script("window.testWallet.answer(...arguments)", call["id"], error, value)

    def until(self, condition: Callable[[], Any], what: str = "") -> Any:
        """What `condition` gives when it is true; the wallet answers meanwhile."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            self.serve_wallet()
            try:
                if found := condition():
                    return found
            except (StaleElementReferenceException, NoSuchElementException, StopIteration):
                pass
            time.sleep(0.05)
        raise AssertionError(f"{what or 'it'} did not come; the page says:\n{self.text()}\n{self.log()}")

    def find(self, css: str) -> WebElement:
        """The first element, when it is there and can be seen."""
        found: WebElement = self.until(lambda: next(one for one in self.all(css) if one.is_displayed()), css)
        return found

    def all(self, css: str) -> list[WebElement]:
        """All elements that are there now."""
        return self.driver.find_elements(By.CSS_SELECTOR, css)

    def click(self, css: str) -> None:
        """Click the element, when it is enabled."""
        self.until(lambda: next(one for one in self.all(css) if one.is_displayed() and one.is_enabled()), css)
        self.until(lambda: self._clicked(css), f"a click on {css}")

    def _show(self, element: WebElement) -> None:
        """Move it into the middle of the screen, away from what stands above the page on phones."""
        self.driver.execute_script("arguments[0].scrollIntoView({ block: 'center' })", element)

    def _clicked(self, css: str) -> bool:
        try:
            one = next(one for one in self.all(css) if one.is_displayed() and one.is_enabled())
            self._show(one)
            one.click()
        except WebDriverException:
            return False
        return True

    def press(self, words: str) -> None:
        """Click the button or link with these words."""
        path = f"//*[self::button or self::a or self::summary][contains(normalize-space(.), {json.dumps(words)})]"

        def pressed() -> bool:
            one = next(
                one for one in self.driver.find_elements(By.XPATH, path) if one.is_displayed() and one.is_enabled()
            )
            try:
                self._show(one)
                one.click()
            except WebDriverException:
                return False
            return True

        self.until(pressed, f"the button {words!r}")

    def tab_to(self, css: str) -> None:
        """Move the focus there by the Tab key alone."""
        self.find(css)
        for _ in range(120):
            if self.driver.execute_script("return document.activeElement?.matches(arguments[0])", css):
                return
            self.keys(Keys.TAB)
        raise AssertionError(f"the Tab key does not come to {css}")

    def keys(self, *keys: str) -> None:
        """Press keys, as a person without a mouse does."""
        ActionChains(self.driver).send_keys(*keys).perform()
        self.serve_wallet()

    def lie(self, path: str, change: str) -> None:
        """From the next page on, pass each answer whose path matches `path` to `change`: code that alters `body`."""
        script = f"""{{
        const honest = window.fetch;
        window.fetch = async (path, init) => {{
          const answer = await honest(path, init);
          if (!/{path}/.test(String(path))) return answer;
          const isFile = /files\\/\\w+$/.test(String(path));
          const body = isFile ? new Uint8Array(await answer.arrayBuffer()) : await answer.json();
          {change};
          const {{ headers, status }} = answer;
          return new Response(isFile ? body : JSON.stringify(body), {{ headers, status }});
        }};
        }}"""
        self.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": script})

    def label(self, words: str) -> WebElement:
        """The label with these words, when it can be seen."""
        path = f"//label[contains(normalize-space(.), {json.dumps(words)})]"
        found: WebElement = self.until(
            lambda: next(one for one in self.driver.find_elements(By.XPATH, path) if one.is_displayed()), words
        )
        return found

    def type(self, label: str, text: str) -> None:
        """Write a text into the field with this label."""
        field = self.driver.find_element(By.ID, self.label(label).get_attribute("for") or "")
        field.send_keys(Keys.CONTROL + "a")
        field.send_keys(text)

    def text(self) -> str:
        """All that can be read."""
        text: str = self.driver.execute_script("return document.body.innerText")
        return text

    def sees(self, words: str) -> None:
        """Wait until these words can be read."""
        self.until(lambda: words in self.text(), f"the text {words!r}")

    def log(self) -> list[str]:
        """What the console has said since the last call."""
        return [entry["message"] for entry in self.driver.get_log("browser")]  # type: ignore[no-untyped-call]

    def errors(self) -> list[str]:
        """What the console has said since the last call, but for requests that nobody answered."""
        entries = self.driver.get_log("browser")  # type: ignore[no-untyped-call]
        return [str(entry) for entry in entries if entry["source"] != "network"]

    def connect(self) -> None:
        """Connect the test's wallet by clicks."""
        self.click("#connect")
        self.press("Test wallet")
        self.find("#account")

    def picture(self, path: Path) -> None:
        """A screenshot of the whole page."""
        size = self.driver.execute_script("return [innerWidth, Math.min(document.documentElement.scrollHeight, 4000)]")
        clip = {"x": 0, "y": 0, "width": size[0], "height": size[1], "scale": 1}
        shot = self.driver.execute_cdp_cmd("Page.captureScreenshot", {"clip": clip, "captureBeyondViewport": True})
        path.write_bytes(base64.b64decode(shot["data"]))

    def violations(self) -> list[str]:
        """What axe finds against WCAG 2.2 AA on this page."""
        self.driver.execute_script(require("axe").read_text() + ";window.axe = axe;")
        tags = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa"]
        script = "const done = arguments[1]; axe.run({ runOnly: arguments[0] }).then((r) => done(r.violations))"
        found = self.driver.execute_async_script(script, tags)
        return [f"{one['id']}: {node['html'][:120]}" for one in found for node in one["nodes"]]
