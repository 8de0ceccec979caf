"""Cassie: names, model, closed loops, ground."""
