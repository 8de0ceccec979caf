"""What memory a run would take."""

import pytest

from cassie_mjx.envs.config import WALK_PRESETS, WalkConfig
from cassie_mjx.ppo.config import PPO_PRESETS, PPOConfig
from cassie_mjx.training import memory
from cassie_mjx.training.config import TrainConfig, resolve_config

GB = 1e9


def test_a_run_beyond_the_memory_is_refused_with_what_it_would_take(monkeypatch):
    ppo = PPOConfig(num_robots=1_000_000, num_steps=300)
    with pytest.raises(ValueError, match=r"^ppo.num_robots=1000000, .* about 1,\d\d\d GB of memory, and"):
        resolve_config(TrainConfig(ppo=ppo, physics="native"))
    monkeypatch.setattr(memory, "present_bytes", lambda physics: 2000 * GB)
    assert resolve_config(TrainConfig(ppo=ppo, physics="native")).ppo == ppo


@pytest.mark.parametrize("physics", ["native", "mjx"])
def test_the_presets_fit_a_small_machine(physics):
    for ppo in PPO_PRESETS.values():
        for walk in WALK_PRESETS.values():
            assert memory.needed_bytes(ppo, walk, physics, 1000) < 2 * GB


def test_samples_take_what_was_measured():
    """At 64 units, 130,560 samples more took 597 MB more on MuJoCo C."""
    few, many = (PPOConfig(num_robots=64, num_steps=steps, hidden_sizes=(64, 64)) for steps in (8, 2048))
    difference = memory.needed_bytes(many, WalkConfig(), "native", 500) - memory.needed_bytes(
        few, WalkConfig(), "native", 500
    )
    assert difference == pytest.approx(597e6, rel=0.1)


def test_what_a_gru_takes_besides_is_what_was_measured():
    """At 64 units, the learner's update took 225 MB more for 126,976 samples of a GRU than of a perceptron."""
    sizes = []
    for network, robots in (("gru", 2048), ("gru", 64), ("mlp", 2048), ("mlp", 64)):
        ppo = PPOConfig(network=network, num_robots=robots, num_steps=64, hidden_sizes=(64, 64))
        sizes.append(memory.needed_bytes(ppo, WalkConfig(), "native", 500))
    assert sizes[0] - sizes[1] - (sizes[2] - sizes[3]) == pytest.approx(225e6, rel=0.1)


def test_wide_networks_count():
    wide = PPOConfig(hidden_sizes=(65_536, 65_536))
    assert memory.needed_bytes(wide, WalkConfig(), "native", 500) > 170 * GB
