"""The agent API: what users write agents with."""

from mesh.agent.agent import Agent
from mesh.agent.contract import Contract, Outcome
from mesh.agent.errors import ContractTakenBack, JobFailed, OrderExpired, OrderRejected, ShortOfFunds
from mesh.work.lifecycle import Phase

__all__ = [
    "Agent",
    "Contract",
    "ContractTakenBack",
    "JobFailed",
    "OrderExpired",
    "OrderRejected",
    "Outcome",
    "Phase",
    "ShortOfFunds",
]
