"""The agent API: what users write agents with."""

from mesh.agent.agent import Agent
from mesh.agent.hooks import JobFailed
from mesh.agent.trade import Contract, OrderExpired, OrderRejected, Outcome, ShortOfFunds
from mesh.work.lifecycle import Phase

__all__ = ["Agent", "Contract", "JobFailed", "OrderExpired", "OrderRejected", "Outcome", "Phase", "ShortOfFunds"]
