"""The documentation as a site: `make docs` makes it of docs/, docstrings and definitions."""
