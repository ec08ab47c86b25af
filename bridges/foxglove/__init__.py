"""Foxglove: a live view of the market, of an agent and of a job, and finished jobs to scrub through."""
