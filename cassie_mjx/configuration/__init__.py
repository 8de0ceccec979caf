"""What the values of a configuration can be."""
