"""docs/numbers.md: its tables say what the code does. Its metrics are compared with those of a run in test_train.py."""

import re
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from cassie_mjx.control.observation import OBSERVATIONS, Seen
from cassie_mjx.envs import reward
from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.envs.termination import Ends
from cassie_mjx.robot import cassie
from cassie_mjx.training.config import TrainConfig, flat

DOCS = Path(__file__).parents[1] / "docs"
PAGE = (DOCS / "numbers.md").read_text()
OBSERVATION = OBSERVATIONS["full"]


def table(heading):
    """Cells of the first table under a heading, without its head."""
    text = re.split(rf"^#+ {heading}$", PAGE, flags=re.M)[1]
    rows = re.findall(r"(?:^\|.*\n)+", text, re.M)[0].splitlines()[2:]
    return [[cell.strip().strip("`") for cell in row.strip("|").split("|")] for row in rows]


def halves():
    """An observation of numbers that all differ, and the states of robot and reference that it is made of."""
    numbers = np.random.default_rng(0).uniform(0.1, 1, 2 * (cassie.NQ + cassie.NV))
    qpos, qvel, reference_qpos, reference_qvel = np.split(numbers, np.cumsum([cassie.NQ, cassie.NV, cassie.NQ]))
    seen = Seen(qpos[None], qvel[None], reference_qpos[None], reference_qvel[None])
    observation, _ = OBSERVATION.update(OBSERVATION.init(seen), seen)
    return observation[0], ({"qpos": qpos, "qvel": qvel}, {"qpos": reference_qpos, "qvel": reference_qvel})


def test_the_eighty_inputs():
    observation, states = halves()
    terms = [term for term in OBSERVATION.terms for _ in range(term.size)]
    found = []
    for name, unit, frame, address, *places in table("Pelvis"):
        vector, index = address.rstrip("]").split("[")
        for place, state in zip(map(int, places), states, strict=True):
            assert observation[place] == state[vector][int(index)]
            assert terms[place].unit == unit
            assert frame == ("world" if name.startswith("quaternion") else terms[place].frame)
            found.append(place)
    for name, *places in table("Joints"):
        angle, velocity = cassie.qpos_index(name)[0], cassie.qvel_index(name)[0]
        expected = [state[vector][i] for state in states for vector, i in (("qpos", angle), ("qvel", velocity))]
        assert [observation[int(place)] for place in places] == expected
        assert [terms[int(place)].unit for place in places] == ["rad", "rad/s"] * 2
        found += map(int, places)
    assert sorted(found) == list(range(OBSERVATION.size))


def test_joints_and_gains():
    expected = [
        [
            str(action),
            joint,
            f"{cassie.qpos_index(joint)[0]}, {cassie.qvel_index(joint)[0]}",
            *(f"{numbers[action]:g}" for numbers in (cassie.P_GAIN, cassie.D_GAIN, cassie.TORQUE_LIMIT, cassie.GEAR)),
        ]
        for action, joint in enumerate(cassie.ACTUATORS)
    ]
    assert table("Actions, joints and gains") == expected


@pytest.mark.parametrize("name", reward.SCALES)
def test_the_reward(name):
    """As the table and the formula say, with numbers that all differ."""
    random = np.random.default_rng(0)
    qpos, reference = random.uniform(0.1, 0.5, (2, cassie.NQ))
    errors = {
        "joint": cassie.qpos_index(*cassie.ACTUATORS),
        "position": cassie.qpos_index("pelvis")[:3],
        "orientation": cassie.qpos_index("pelvis")[4:],
        "spring": cassie.qpos_index("left-shin", "right-shin"),
    }
    expected, weights = 0.0, []
    for term, weight, _, *factors in table("Reward"):
        numbers = re.findall(r"[\d.]+", factors[list(reward.SCALES).index(name)].partition(" for ")[0])
        factor = np.array(numbers, float)
        index = errors[term]
        scale = np.tile(factor, len(index) // len(factor))
        expected += float(weight) * np.exp(-(scale * (qpos - reference)[index] ** 2).sum())
        weights.append(f"{weight} {term}")
    assert f"reward = {' + '.join(weights)}\n" in PAGE
    found = reward.total(reward.terms(reward.SCALES[name], qpos, reference))
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_ends_of_an_episode():
    rows = table("Ends of an episode")
    assert {name for name, *_ in rows} == set(Ends._fields)
    defaults = flat({"walk": asdict(WalkConfig())})
    for _, when, key in rows:
        assert not key or f"{defaults[key]:g}" in when.split()
    (fall,) = (when for name, when, _ in rows if name == "fallen")
    assert f"less than {cassie.FALL_LOW_M} m or more than {cassie.FALL_HIGH_M} m" in fall
    assert f"{WalkConfig().episode_steps} steps (`walk.episode_steps`)" in PAGE


KEYS = set(flat(asdict(TrainConfig())))


@pytest.mark.parametrize("page", sorted(set(DOCS.glob("*.md")) - {DOCS / "extending.md"}), ids=lambda page: page.stem)
def test_keys_that_pages_name_exist(page):
    named = set(re.findall(r"(?<![\w.])(?:ppo|walk)\.[a-z_0-9]+(?:\.[a-z_0-9]+)*", page.read_text()))
    named = {name for name in named if not name.endswith((".npz", ".gif", ".mp4", ".py"))}
    assert named <= KEYS | {"walk.scenario"}
