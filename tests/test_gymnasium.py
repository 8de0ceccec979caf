"""Gymnasium's views: its own checkers, what `SyncVectorEnv` does, seeds, frames, its wrappers, a learner."""

import subprocess
import sys
import warnings
from dataclasses import replace
from itertools import pairwise

import jax
import numpy as np
import pytest

from cassie_mjx.envs.config import WALK_PRESETS, WalkConfig
from cassie_mjx.robot import drawing

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AutoresetMode, SyncVectorEnv  # noqa: E402
from gymnasium.wrappers.vector import RecordEpisodeStatistics  # noqa: E402

ID = "CassieMJX/Walk-v0"
ROBOTS = 2
SHORT = WalkConfig(episode_steps=3, min_reward=None, max_position_error_m=None)


def actions(steps):
    return np.random.default_rng(0).uniform(-0.3, 0.3, (steps, ROBOTS, 10)).astype(np.float32)


def many(robots=ROBOTS, **given):
    return gymnasium.make_vec(ID, num_envs=robots, physics_hz=500, **given)


@pytest.fixture(scope="module")
def drawn():
    try:
        drawing.choose_backend()
    except ValueError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def envs():
    """Two robots whose episodes end with every third step."""
    return many(config=SHORT)


def rough():
    return many(config=replace(WALK_PRESETS["robust"], episode_steps=5), speed="any", render_mode="rgb_array")


def test_one_robot_passes_gymnasiums_checker(drawn):
    env = gymnasium.make(ID, render_mode="rgb_array", physics_hz=500)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # The observation is of states, which have no bounds.
        warnings.filterwarnings("ignore", ".*A Box observation space m.* value is -?infinity.*")
        check_env(env.unwrapped)
    env.close()


def test_spaces_and_what_vectors_say_of_themselves(envs):
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert envs.num_envs == ROBOTS
    assert envs.observation_space.shape == (ROBOTS, 80)
    assert envs.single_observation_space.shape == (80,)
    assert envs.single_action_space == gymnasium.spaces.Box(-1, 1, (10,), np.float32)
    seen, infos = envs.reset(seed=0)
    assert envs.observation_space.contains(seen)
    assert infos == {}
    seen, reward, terminated, truncated, infos = envs.step(envs.action_space.sample())
    assert envs.observation_space.contains(seen)
    assert (reward.dtype, terminated.dtype, truncated.dtype) == (float, bool, bool)
    assert {"weighted", "joint", "fallen"} <= infos.keys()
    assert seen.flags.writeable


def test_a_step_is_the_tasks(envs, monkeypatch):
    task, keys = envs.unwrapped._robots._env, []
    step = task.step

    def noted(state, action, key):
        keys.append(key)
        return step(state, action, key)

    monkeypatch.setattr(task, "step", noted)
    envs.reset(seed=1)
    state = envs.unwrapped._robots.state
    for action in actions(7):
        seen, reward, terminated, truncated, _ = envs.step(action)
        state = step(state, action, keys[-1])
        np.testing.assert_array_equal(seen, state.observation)
        np.testing.assert_array_equal(reward, np.asarray(state.reward, float))
        np.testing.assert_array_equal(terminated, state.terminated)
        np.testing.assert_array_equal(truncated, state.truncated)
    assert len({tuple(jax.random.key_data(key).tolist()) for key in keys}) == 7


def structure(infos):
    return {
        name: structure(value) if isinstance(value, dict) else (type(value), value.dtype, value.shape)
        for name, value in infos.items()
    }


def test_episodes_end_as_in_gymnasiums_own_vectors(envs):
    def single():
        return gymnasium.make(ID, config=SHORT, physics_hz=500)

    theirs = SyncVectorEnv([single] * ROBOTS, autoreset_mode=AutoresetMode.SAME_STEP)
    envs.reset(seed=0)
    theirs.reset(seed=0)
    for number, action in enumerate(actions(6), 1):
        seen, _, _, truncated, infos = envs.step(action)
        *_, their_truncated, their_infos = theirs.step(action)
        np.testing.assert_array_equal(truncated, [number % 3 == 0] * ROBOTS)
        np.testing.assert_array_equal(truncated, their_truncated)
        np.testing.assert_array_equal(infos["_weighted"], ~truncated)
        if not truncated.any():
            assert structure(infos) == structure(their_infos)
            continue
        # Gymnasium leaves out the infos that no robot has.
        assert structure({name: infos[name] for name in their_infos}) == structure(their_infos)
        for last, first, their_last in zip(infos["final_obs"], seen, their_infos["final_obs"], strict=True):
            assert (last.shape, last.dtype) == (their_last.shape, their_last.dtype) == ((80,), np.float32)
            assert np.abs(last - first).max() > 0.01, "the next episode has begun elsewhere"
    theirs.close()


def test_gymnasiums_wrapper_adds_up_the_rewards_of_an_episode(envs):
    counted = RecordEpisodeStatistics(envs)
    counted.reset(seed=0)
    steps = [counted.step(action) for action in actions(3)]
    infos = steps[-1][-1]
    np.testing.assert_allclose(infos["episode"]["r"], sum(reward for _, reward, *_ in steps), rtol=1e-6)
    assert infos["episode"]["l"].tolist() == [3] * ROBOTS


def walked(envs, seed):
    seen, _ = envs.reset(seed=seed)
    return [seen, *(part for action in actions(12) for part in envs.step(action)[:4])]


def test_a_seed_repeats_everything_exactly():
    envs, other = rough(), rough()
    for one, two, three in zip(walked(envs, 7), walked(envs, 7), walked(other, 7), strict=True):
        np.testing.assert_array_equal(one, two)
        np.testing.assert_array_equal(one, three)
    assert not np.array_equal(envs.reset(seed=7)[0], envs.reset(seed=8)[0])
    assert not np.array_equal(envs.reset()[0], envs.reset()[0]), "without a seed it goes on from where it is"


def test_the_end_of_an_episode_is_seen_and_drawn(drawn):
    env = gymnasium.make(ID, config=SHORT, physics_hz=500, render_mode="rgb_array")
    env.reset(seed=0)
    frames, steps = [env.render()], []
    for action in actions(3):
        steps.append(env.step(action[0]))
        frames.append(env.render())
    assert [ends for _, _, *ends, _ in steps] == [[False, False], [False, False], [False, True]]
    assert {"weighted", "fallen"} <= steps[-1][-1].keys()
    assert all(frame.shape == (480, 640, 3) and frame.dtype == np.uint8 for frame in frames)
    moved = [np.abs(a.astype(int) - b).mean() for a, b in pairwise(frames)]
    assert moved[0] > 0.1
    assert moved[2] == 0, "not the next episode, which begins elsewhere"
    env.close()


def test_many_robots_are_drawn_each_on_its_terrain(drawn):
    envs = rough()
    envs.reset(seed=0)
    frames = envs.render()
    assert len(frames) == ROBOTS
    heights = set(np.asarray(envs.unwrapped._robots.state.scenario.ground.sine).tolist())
    assert {height for height, *_ in envs.unwrapped._robots._renderers} == heights
    assert len(heights) > 1
    assert np.abs(frames[0].astype(int) - frames[1]).mean() > 0.1
    envs.close()


def test_nothing_is_drawn_unless_asked_for(envs):
    envs.reset(seed=0)
    assert envs.render() is None


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"speed": "9x"}, "speed=9x is not a speed; give a factor from 0x to 4x"),
        ({"config": "rough"}, "config='rough' is not known; choose one of undisturbed, robust."),
        ({"physics_hz": 700}, "physics_hz=700 does not divide the control step"),
        ({"num_envs": 0}, "num_envs=0 must be at least 1."),
        ({"render_mode": "ansi"}, "render_mode='ansi' is not known; choose rgb_array"),
        ({"motion": "dance"}, "'dance' is neither walk nor a file"),
    ],
)
def test_bad_input_is_one_sentence(given, sentence):
    with pytest.raises(ValueError, match=sentence):
        gymnasium.make_vec(ID, **{"num_envs": 2, **given})


def test_a_step_that_cannot_be_is_one_sentence(envs):
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"call reset\(\) first"):
        many().step(np.zeros((2, 10)))
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"call reset\(\) first"):
        gymnasium.make(ID, render_mode="rgb_array").unwrapped.render()
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=r"The actions of robots \[1\] are not finite; the learner has diverged."):
        envs.step(np.where(np.arange(2)[:, None] == 1, np.nan, np.zeros((2, 10))))
    with pytest.raises(ValueError, match=r"An action of shape \(2, 9\) was given; 2 robots take \(2, 10\)."):
        envs.step(np.zeros((2, 9)))


def python(program):
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert not done.stderr
    return done.stdout.splitlines()


def test_importing_the_package_imports_no_gymnasium():
    assert python("import sys, cassie_mjx; print('gymnasium' in sys.modules)") == ["False"]


BOTH = ("import cassie_mjx, gymnasium", "import gymnasium, cassie_mjx")


@pytest.mark.parametrize("imports", BOTH)
def test_the_id_is_known_once_both_are_imported(imports):
    program = f"""
import sys
{imports}
print(gymnasium.spec("{ID}").vector_entry_point, *{{"jax", "mujoco"}} & sys.modules.keys())
print(gymnasium.__spec__.loader.get_filename("gymnasium") == gymnasium.__file__)
"""
    assert python(program) == ["cassie_mjx.envs.gymnasium_env:GymnasiumVectorEnv", "True"]


@pytest.mark.parametrize(("imports", "name"), [(BOTH[0], ID), ("import gymnasium", f"cassie_mjx:{ID}")])
def test_sixty_four_robots_in_a_fresh_process(imports, name):
    program = f"""
import warnings
{imports}
warnings.simplefilter("error")
print(gymnasium.make_vec("{name}", num_envs=64).observation_space.shape)
"""
    assert python(program) == ["(64, 80)"]


@pytest.mark.parametrize("module", ["gymnasium", "no_such_module"])
def test_a_module_that_is_not_there_is_still_not_there(module):
    program = f"""
import sys, cassie_mjx
sys.path = [p for p in sys.path if "site-packages" not in p]
try:
    import {module}
except ModuleNotFoundError as error:
    print(error)
"""
    assert python(program) == [f"No module named '{module}'"]


def test_without_gymnasium_it_says_what_to_install():
    program = """
import sys
sys.modules["gymnasium"] = None
try:
    import cassie_mjx.envs.gymnasium_env
except ImportError as error:
    print(error)
"""
    (said,) = python(program)
    assert said == "Gymnasium's view needs the package gymnasium; pip install 'cassie-mjx[gymnasium]'."


@pytest.mark.slow
def test_a_foreign_learner_learns_on_it():
    """The cross-entropy method finds ten constant residuals that keep robots nearer to the reference."""
    robots, elite, random = 64, 12, np.random.default_rng(0)
    envs = many(robots)
    mean, spread, returns = np.zeros(10), np.full(10, 0.1), []
    for generation in range(8):
        chosen = random.normal(mean, spread, (robots, 10)).astype(np.float32)
        envs.reset(seed=generation)
        total, going = np.zeros(robots), np.ones(robots, bool)
        for _ in range(15):
            _, reward, terminated, truncated, _ = envs.step(chosen)
            total += reward * going
            going &= ~(terminated | truncated)
        best = chosen[np.argsort(total)[-elite:]]
        mean, spread = best.mean(axis=0), best.std(axis=0)
        returns.append(total.mean())
    assert np.mean(returns[-2:]) > returns[0] + 1, returns
