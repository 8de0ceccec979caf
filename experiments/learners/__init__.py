"""Other libraries' learners on our task, each a command that `experiments.peers` runs."""
