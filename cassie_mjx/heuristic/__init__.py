"""The hand-made controller that records the reference motion."""
