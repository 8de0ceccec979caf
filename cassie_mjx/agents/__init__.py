"""What can walk: policies, blends of them, the heuristic controller."""
