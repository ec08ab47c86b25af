"""A whole market in one process: for a first look, and for development."""
