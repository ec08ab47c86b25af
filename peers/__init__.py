"""The real programs that tests run against: where each is, and how `make peers` installs it. Standard library only."""
