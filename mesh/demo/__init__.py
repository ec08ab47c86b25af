"""`aira demo`: a whole market in one process, and one job on it."""
