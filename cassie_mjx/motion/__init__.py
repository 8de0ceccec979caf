"""The reference motion."""
