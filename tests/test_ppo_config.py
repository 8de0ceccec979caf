"""The learner's configuration: the presets carry the published figures, and a bad value is refused in one sentence."""

from dataclasses import FrozenInstanceError, replace

import pytest

from cassie_mjx.ppo.config import PPO_PRESETS, PPOConfig


def test_paper_preset_carries_the_papers_figures():
    paper = PPO_PRESETS["paper"]
    assert paper.num_samples <= 3000
    assert (paper.updates_per_iteration, paper.minibatch_size, paper.iterations) == (64, 128, 300)
    assert (paper.actor_learning_rate, paper.critic_learning_rate) == (1e-3, 1e-2)
    assert (paper.learning_rate_decay, paper.learning_rate_floor) == (0.99, 0.1)
    assert paper.action_std**2 == pytest.approx(0.018, rel=0.01)
    assert (paper.clip_epsilon, paper.hidden_sizes, paper.normalizer_samples) == (0.2, (256, 256), 50_000)


@pytest.mark.parametrize("name", ["parallel", "massive"])
def test_parallel_and_massive_make_five_epochs(name):
    preset = PPO_PRESETS[name]
    assert preset.updates_per_iteration * preset.minibatch_size == 5 * preset.num_samples


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"num_robots": 0}, "num_robots=0 must be a whole number from 1 to 1,000,000."),
        ({"num_steps": -3}, "num_steps=-3 must be a whole number from 1 to 100,000."),
        ({"action_std": 0.0}, "action_std=0.0 must be from 0.0001 to 10."),
        ({"gamma": 1.5}, "gamma=1.5 must be from 0 to 1."),
        ({"gae_lambda": float("nan")}, "gae_lambda=nan must be from 0 to 1."),
        ({"target_kl": 0.0}, "target_kl=0.0 must be from 1e-06 to 100, or null."),
        ({"learning_rate_decay": 0.0}, "learning_rate_decay=0.0 must be from 0.01 to 1."),
        (
            {"actor_schedule": "late"},
            "actor_schedule=late is not known; choose one of constant, linear, cosine, exponential.",
        ),
        ({"hidden_sizes": ()}, r"hidden_sizes=\[\] must be 1 to 64 widths."),
        ({"hidden_sizes": (256, 0)}, "hidden_sizes=256,0: each must be a whole number from 1 to 65,536."),
        ({"minibatch_size": 5000}, "minibatch_size=5000 must be at most num_robots x num_steps = 1024."),
        ({"final_action_std": 0.2}, "final_action_std=0.2 must be at most action_std=0.134, or null."),
        ({"action_std": float("inf")}, "action_std=inf must be from 0.0001 to 10."),
        ({"actor_learning_rate": float("inf")}, "actor_learning_rate=inf must be from 1e-09 to 1."),
        ({"num_robots": 2.5}, "num_robots=2.5 must be a whole number from 1 to 1,000,000."),
        ({"num_robots": None}, "num_robots=null must be a whole number from 1 to 1,000,000."),
    ],
)
def test_bad_value_is_refused_in_one_sentence(change, sentence):
    with pytest.raises(ValueError, match=f"^{sentence}$"):
        PPOConfig(**change)


def test_configuration_is_frozen_hashable_and_takes_a_list_of_widths():
    config = replace(PPO_PRESETS["parallel"], hidden_sizes=[64, 32])
    assert config.hidden_sizes == (64, 32)
    assert hash(config) == hash(replace(config))
    with pytest.raises(FrozenInstanceError):
        config.gamma = 0.9
