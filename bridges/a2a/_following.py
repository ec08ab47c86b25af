"""The changes of a job, for streams and for push notifications."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from mesh.base.retry import Backoff, RetryPolicy
from mesh.errors import AiraError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.signer.client import SignerClient
    from mesh.signer.protocol import Job

WAIT: Final = 25.0
"""Seconds of one look at a job."""
RETRY: Final = RetryPolicy(initial=1.0, ceiling=5.0)
"""How a signer that does not answer is asked again."""
UNKNOWN: Final = frozenset({"invalid-request", "unknown-job"})
"""The codes of errors for a job that there is none of."""


async def changes(signer: SignerClient, job_id: str) -> AsyncIterator[Job]:
    """A job as it is now, then each time it has changed; the last time when it is over.

    Waits while the signer is away. Raises the `AiraError` of a job that there is none of.
    """
    before: Job | None = None
    revision, backoff = -1, Backoff(RETRY)
    while True:
        try:
            job = await signer.job(job_id, revision=revision, wait_seconds=WAIT)
        except AiraError as error:
            if error.code in UNKNOWN:
                raise
            revision = -1  # after a restart it may be the same for something else
            await backoff.wait()
            continue
        backoff.reset()
        revision = job.revision
        if job != before:
            before = job
            yield job
        if job.is_over:
            return
