"""One recipe for each experiment; each writes a JSON result with its provenance."""

import cassie_mjx  # noqa: F401  before jax, whose log it quiets
