"""The crash matrix: real processes, a real router and anvil, and a fault at each point of a job (`make crash-test`)."""
