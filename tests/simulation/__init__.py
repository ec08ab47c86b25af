"""A deterministic simulator of whole markets: `make simulate`, described in docs/explanation/simulator.md."""
