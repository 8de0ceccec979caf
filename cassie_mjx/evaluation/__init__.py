"""Trials of agents: simulated, scheduled, measured, filmed."""
