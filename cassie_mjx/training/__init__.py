"""A training run: its loop, its state, its files."""
