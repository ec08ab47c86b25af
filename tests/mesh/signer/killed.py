"""A signer in a process of its own, which kills itself at a step: `python killed.py FACTS.json [STEP]`."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from pathlib import Path
from typing import Any, NoReturn

from mesh.agent.ledger import Outbox
from mesh.chain import Account, Chain, ContractNames
from mesh.settings import load
from mesh.signer._kept import Budget
from mesh.signer.service import Signer
from mesh.testing._market import RESEND, TIMING


def die(*_: Any, **__: Any) -> NoReturn:
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError


def before(owner: Any, name: str, when: Any = lambda *_: True) -> None:
    """Die instead of calling a method."""
    method = getattr(owner, name)
    setattr(owner, name, lambda *args, **options: die() if when(*args) else method(*args, **options))


def after(owner: Any, name: str, when: Any = lambda *_: True) -> None:
    """Die when a method has returned."""
    method = getattr(owner, name)

    async def call(*args: Any, **options: Any) -> Any:
        found = await method(*args, **options)
        return die() if when(*args) else found

    def call_now(*args: Any, **options: Any) -> Any:
        found = method(*args, **options)
        return die() if when(*args) else found

    setattr(owner, name, call if asyncio.iscoroutinefunction(method) else call_now)


def is_new(_: Any, job: Any, *__: Any) -> bool:
    return job.hold == "open" and not job.order and job.revision == 0


def is_demand(_: Any, message: Any) -> bool:
    return bool(message.kind == "demand")


STEPS = {
    "before it is kept": lambda: before(Budget, "put", is_new),
    "once it is kept": lambda: after(Budget, "put", is_new),
    "before it is signed": lambda: before(Signer, "_place"),
    "before its hash is kept": lambda: before(Signer, "_signed"),
    "once its hash is kept": lambda: after(Signer, "_signed"),
    "before it is posted": lambda: before(Outbox, "post", is_demand),
    "once it is posted": lambda: after(Outbox, "post", is_demand),
    "before its contract is known": lambda: before(Signer, "_accepted"),
    "while it is followed": lambda: before(Signer, "_follow"),
    "before its end is kept": lambda: before(Signer, "_end"),
}


async def main(facts: dict[str, Any], step: str) -> None:
    if step:
        STEPS[step]()
    account = Account(bytes.fromhex(facts["key"]))
    settings = load(flags=facts["settings"] | {"connect": tuple(facts["settings"]["connect"])}, environ={})
    chain = Chain(
        facts["node"], account=account, contracts=ContractNames(ens=facts["settings"]["ens_contract"]), timing=TIMING
    )
    async with chain, Signer(settings, Path(facts["policy"]), account=account, chain=chain, resend=RESEND):
        await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(main(json.loads(Path(sys.argv[1]).read_text()), "".join(sys.argv[2:])))
