"""Agents: what users write (`agent`, `handlers`), their orders and contracts, and the jobs that they do."""
