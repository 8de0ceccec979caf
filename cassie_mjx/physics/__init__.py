"""Two engines behind one protocol: MJX for accelerators, MuJoCo C for CPUs and for every headline figure."""
