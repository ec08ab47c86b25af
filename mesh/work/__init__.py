"""Work: from a liability that names an agent to a signed Result, and the memory that outlives a crash."""

from mesh.work.ledger import JobRecord, Ledger, Outgoing, StoredOrder
from mesh.work.phases import Phase, WrongPhase
