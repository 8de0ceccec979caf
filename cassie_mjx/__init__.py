"""Cassie MJX: a massively parallel training pipeline for the Cassie biped, on MJX and on MuJoCo C."""

import os

# XLA on CPU calls every program that it loads from the compilation cache a possible mismatch, in pages of CPU features
# (it compares with features that it added itself), so only what is fatal is shown; errors still raise.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
