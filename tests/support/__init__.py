"""Real servers for tests: each on loopback and free ports, with a state folder of its own, stopped by its own pid."""
