"""A door for agents that speak A2A (Agent2Agent): `aira a2a`."""
