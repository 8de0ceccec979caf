"""One recipe for each experiment; each writes a JSON result with its provenance."""
