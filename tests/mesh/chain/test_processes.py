"""Several processes that share one embedded chain, and the recursion limit in its process."""

from __future__ import annotations

import asyncio
import sys
from typing import TYPE_CHECKING

from mesh.chain import XRT, Account, Chain, deploy, new_private_key
from tests.mesh.chain.conftest import QUICK
from tests.support.development import serve_embedded

if TYPE_CHECKING:
    from pathlib import Path

CHILD = """
import asyncio, sys
from mesh.chain import Account, Chain, Timing

async def main(url, key, friend, count):
    timing = Timing(poll_interval=0.05, receipt_interval=0.01)
    async with Chain(url, account=Account(bytes.fromhex(key)), timing=timing) as chain:
        await asyncio.gather(*(chain.tokens.transfer(friend, 1) for _ in range(int(count))))
        print(await chain.block_number())

asyncio.run(main(*sys.argv[1:]))
"""


NESTING = """
import asyncio, sys, threading, msgspec
import mesh.chain, mesh.dev

def decode():
    try:
        msgspec.json.decode(b"[" * 50_000)
    except RecursionError:
        print("refused")

async def main():
    decode_in_small_thread()
    mesh.chain.write_keyfile(sys.argv[1], mesh.chain.new_private_key(), "password")
    decode_in_small_thread()
    async with mesh.dev.EmbeddedChain():
        decode_in_small_thread()

def decode_in_small_thread():
    thread = threading.Thread(target=decode)
    thread.start()
    thread.join()

threading.stack_size(2 * 1024 * 1024)
asyncio.run(main())
"""


async def _child(program: str, *arguments: str) -> tuple[int | None, str]:
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", program, *arguments, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
    )
    out, errors = await process.communicate()
    return process.returncode, (out + errors).decode()


async def test_processes_with_separate_and_shared_accounts_lose_no_transaction() -> None:
    friend = Account(new_private_key()).address
    async with serve_embedded() as served:
        deployer = Account(served.node.funded_keys[0])
        await deploy(served.node.provider, deployer)
        async with Chain(served.url, account=deployer, timing=QUICK) as chain:
            other = served.node.funded_keys[1]
            await chain.tokens.transfer(Account(other).address, XRT)
            keys = (served.node.funded_keys[0], other, other)
            ended = await asyncio.gather(*(_child(CHILD, served.url, key.hex(), friend, "8") for key in keys))
            assert [code for code, _ in ended] == [0, 0, 0], ended
            assert await chain.tokens.balance(friend) == 24


async def test_deeply_nested_json_is_refused_where_the_chain_is_imported_and_where_it_runs(tmp_path: Path) -> None:
    """A library below raises the recursion limit so far that a message could end the process."""
    assert await _child(NESTING, str(tmp_path / "key")) == (0, "refused\n" * 3)
