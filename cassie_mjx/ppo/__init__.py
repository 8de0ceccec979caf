"""A functional PPO learner: `init` and `update` on explicit state, and an environment met as two callables."""
