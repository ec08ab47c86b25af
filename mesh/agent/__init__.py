"""The agent API, which users import from `mesh`."""

from mesh.agent.agent import Agent
from mesh.agent.contract import Contract, Outcome
from mesh.agent.errors import Declined, LiabilityReverted, OrderClosed, OrderExpired
from mesh.agent.orders import Order, OrderState
from mesh.agent.progress import Progress
from mesh.work.job import Job, JobFailed
from mesh.work.phases import Phase
