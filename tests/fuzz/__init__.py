"""Seeded attempts to break the product; `python -m tests.fuzz`."""
