"""The agent API, which users import from `mesh`."""

from mesh.agent.agent import Agent
from mesh.agent.contract import Contract, Outcome
from mesh.agent.errors import FundsShort, LiabilityReverted, OrderExpired, OrderRejected
from mesh.work.job import Job, JobFailed
from mesh.work.ledger import Phase

__all__ = [
    "Agent",
    "Contract",
    "FundsShort",
    "Job",
    "JobFailed",
    "LiabilityReverted",
    "OrderExpired",
    "OrderRejected",
    "Outcome",
    "Phase",
]
