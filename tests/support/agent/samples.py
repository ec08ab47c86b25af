"""Liabilities and outgoing messages made up for tests."""

from __future__ import annotations

from mesh.agent.ledger import JobRecord, Outgoing, Phase
from schemas import ZERO_ADDRESS, Liability, checksum_address, cid_of_bytes, keccak256


def liability(name: str = "one", *, promisor: str = ZERO_ADDRESS, objective: str | None = None) -> Liability:
    """A contract that no chain knows, another one for each name."""
    return Liability.of_nobody(
        address=checksum_address(keccak256(name.encode())[:20]),
        model=cid_of_bytes(b"model"),
        objective=objective or cid_of_bytes(b"objective"),
        promisor=promisor,
        cost=2**200,
    )


def job(name: str = "one") -> JobRecord:
    """A job for that contract, before anything is played."""
    return JobRecord(
        liability=liability(name), phase=Phase.READY, success=None, result=None, position=0, recorded=0, note=""
    )


def message(identity: str = "a message", *, deadline: int | None = None) -> Outgoing:
    """A message to be sent."""
    return Outgoing(identity=identity, kind="offer", payload=b"\x00{}", deadline=deadline)
