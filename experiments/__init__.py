"""One recipe for each experiment; each writes a JSON result with its provenance."""

# Before jax, whose log our package quiets.
from cassie_mjx import starting

starting.begin("experiments")
