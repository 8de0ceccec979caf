"""How files are written, whole or not at all, and read, checked before anything in them is used; NumPy alone."""
