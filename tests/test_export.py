"""A policy as a file: the same actions on NumPy alone, and nothing damaged or foreign gets in."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import acting
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from seeing import FULL

from cassie_mjx import export as export_command
from cassie_mjx.agents import numpy_policy
from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.policy_file import learner_policy, save_policy
from cassie_mjx.agents.shipped import policy_path, shipped_policies
from cassie_mjx.export import ExportConfig
from cassie_mjx.motion.files import load_motion
from cassie_mjx.motion.reference import stretch
from cassie_mjx.ppo import learner, normalizer
from cassie_mjx.ppo.config import PPOConfig
from cassie_mjx.robot import cassie


@pytest.fixture(scope="module")
def seen():
    """1,000 observations on scales from 1e-4 to 10, as those of the robot are, the last 10 far outside."""
    rng = np.random.default_rng(0)
    values = rng.normal(size=(1000, FULL.size)) * np.logspace(-4, 1, FULL.size)
    values[-10:] *= 100
    return values.astype(np.float32)


@pytest.fixture(scope="module")
def policy(seen):
    config = PPOConfig(actor_output_scale=1.0)
    drawn = learner.init(jax.random.key(0), config, FULL.size, cassie.NU, 1).policy
    biased = jax.tree.map(lambda x: x + 0.1 if x.ndim == 1 else x, drawn.actor)
    return drawn._replace(actor=biased, normalizer=normalizer.update(drawn.normalizer, jnp.asarray(seen[:-10])))


@pytest.fixture
def path(policy, tmp_path):
    path = tmp_path / "policy.npz"
    motion = stretch(load_motion("walk"), 2.0)
    save_policy(path, policy, motion, 2.0, 0.5, {"return_weighted": 250.0, "commit": "abc"})
    return path


def rewrite(path, **change):
    """The file as one of version 1, without a digest, with other arrays."""
    with np.load(path) as archive:
        content: dict[str, Any] = dict(archive) | {"version": 1} | change
    np.savez(path, **content)


def test_numpy_acts_as_jax_does(policy, path, seen):
    saved = NumpyPolicy.load(path)
    expected = np.asarray(acting.mode(policy, seen))
    assert np.abs(expected).max() > 0.5
    assert np.abs(saved(seen) - expected).max() < 1e-5
    assert saved(seen[0]).shape == (cassie.NU,)
    assert np.abs(saved(seen[0].astype(float)) - expected[0]).max() < 1e-5


def test_the_learner_gets_the_same_policy_back(policy, path, seen):
    back = learner_policy(NumpyPolicy.load(path))
    assert np.abs(np.asarray(acting.mode(back, seen)) - np.asarray(acting.mode(policy, seen))).max() < 1e-5
    assert jax.tree.structure(back) == jax.tree.structure(policy)


def test_the_file_explains_itself(path):
    saved = NumpyPolicy.load(path)
    motion = load_motion("walk")
    assert saved.joints == cassie.ACTUATORS
    assert saved.speed == 2.0
    assert saved.reference_stride_length == pytest.approx(2 * float(motion.stride_length))
    assert np.array_equal(saved.reference_qpos[:, 3:], motion.qpos[:, 3:])
    assert saved.p_gain.tolist() == [100, 100, 88, 96, 50] * 2
    assert saved.d_gain.tolist() == [5, 5, 4, 4.8, 2.5] * 2
    assert saved.observation[0] == "0:2 robot pelvis y, z (world) [m]"
    assert saved.provenance["commit"] == "abc"


def test_it_needs_numpy_alone(path):
    program = f"""
import sys, numpy
from cassie_mjx.agents import numpy_policy
from cassie_mjx.agents.numpy_policy import NumpyPolicy
print(NumpyPolicy.load({str(path)!r})(numpy.zeros(80)).shape)
print(sorted({{"jax", "flax", "mujoco", "brax", "orbax"}} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["(10,)", "[]"]


def test_no_flipped_bit_changes_a_policy(path, seen):
    content, saved = path.read_bytes(), NumpyPolicy.load(path)
    expected, refused = saved(seen), 0
    for position in np.random.default_rng(1).integers(len(content), size=200):
        damaged = bytearray(content)
        damaged[position] ^= 4
        path.write_bytes(damaged)
        try:
            unharmed = NumpyPolicy.load(path)
        except ValueError:
            refused += 1
        else:
            assert np.array_equal(unharmed(seen), expected)
    assert refused > 150


def test_a_file_cut_short_is_refused(path):
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"policy\.npz is damaged"):
        NumpyPolicy.load(path)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"format": "a song"}, "is not a cassie-mjx policy"),
        ({"version": 99}, "has version 99; this program reads versions 1 and 2"),
        ({"version": 2}, "is damaged: files of version 2, and no others, end with their SHA-256"),
        ({"mean": np.zeros(79, np.float32)}, r"mean has shape \(79,\) instead of \(80,\)"),
        ({"weight_1": np.zeros((256, 9), np.float32)}, r"weight_1 has shape \(256, 9\) instead of \(256, 256\)"),
        ({"joints": ["knee"]}, "10 outputs for 1 joints"),
        ({"bias_0": np.zeros(255, np.float32)}, r"bias_0|weight_0"),
        ({"p_gain": np.ones(9)}, r"p_gain has shape \(9,\) instead of \(10,\)"),
        ({"joints": 7}, "a part of it is not of its kind"),
        ({"clip": "wide"}, "a part of it is not of its kind"),
        ({"provenance": "{"}, "is damaged: its provenance is no JSON"),
        ({"provenance": 9999 * "[" + 9999 * "]"}, "is damaged: its provenance is no JSON"),
        ({"provenance": 9999 * '{"a":' + "1" + 9999 * "}"}, "is damaged: its provenance is no JSON"),
        ({"song": 1}, "song missing or too much"),
        ({"version": [1, 1]}, r"has version \[1 1\]; this program reads versions 1 and 2"),
        ({"layers": [3, 3]}, r"not of its kind \(layers has shape \(2,\) and is to be one number\)"),
        ({"layers": 4}, r"not of its kind \(layers is 4, and there are weights of 3\)"),
        ({"observation": [1, 2]}, r"not of its kind \(observation is not a list of texts\)"),
        ({"d_gain": ["5"] * 10}, r"not of its kind \(d_gain does not hold numbers\)"),
        ({"weight_0": [["a"]]}, r"not of its kind \(weight_0 does not hold numbers\)"),
        ({"std": np.zeros(80)}, r"not of its kind \(std is to be above 0\)"),
        ({"clip": -1.0}, r"not of its kind \(clip is to be above 0\)"),
        ({"p_gain": -np.ones(10)}, r"not of its kind \(p_gain is to be above 0\)"),
        ({"samples": -1}, r"not of its kind \(samples is to be at least 0\)"),
        ({"provenance": "[]"}, "is damaged: its provenance has no names"),
        ({"mirror_sides": np.array([54, 61])}, "mirror_action, mirror_observation missing or too much"),
        ({"reference_qpos": np.zeros((22, 34))}, r"\(22, 34\) and reference_qvel \(22, 32\) instead of a row of 35"),
        ({"reference_qvel": np.zeros((22, 35))}, r"reference_qvel \(22, 35\) instead of a row of 35 and one of 32"),
        (
            {"reference_qvel": np.zeros((25, 32))},
            r"\(22, 35\) and reference_qvel \(25, 32\) instead of a row of 35",
        ),
        (
            {"reference_qpos": np.zeros(35), "reference_qvel": np.zeros(32)},
            r"\(35,\) and reference_qvel \(32,\) instead",
        ),
        (
            {"reference_qpos": np.zeros((0, 35)), "reference_qvel": np.zeros((0, 32))},
            r"qvel \(0, 32\) instead of a row",
        ),
    ],
)
def test_parts_that_do_not_fit_are_refused(path, change, sentence):
    rewrite(path, **change)
    with pytest.raises(ValueError, match=f"^{re.escape(str(path))} .*{sentence}"):
        NumpyPolicy.load(path)


@pytest.mark.parametrize("value", [np.nan, -np.inf])
@pytest.mark.parametrize("name", ["weight_1", "bias_2", "mean", "std", "reference_qpos", "p_gain", "clip", "samples"])
def test_what_is_not_finite_is_refused(path, name, value):
    with np.load(path) as archive:
        array = archive[name].copy()
    array.flat[-1] = value
    rewrite(path, **{name: array})
    with pytest.raises(ValueError, match=rf"policy\.npz is damaged: .* \({name} holds NaN or infinity\)"):
        NumpyPolicy.load(path)


def test_another_kind_of_network_is_refused(path, monkeypatch):
    monkeypatch.setattr(numpy_policy, "KIND", "perceptron, ELU")
    with pytest.raises(ValueError, match=r"policy\.npz is a perceptron, ReLU; this version runs a perceptron, ELU"):
        NumpyPolicy.load(path)
    with pytest.raises(ValueError, match=r"1x\.npz is a perceptron, ReLU"):
        NumpyPolicy.load(shipped_policies()["1x"])


def test_another_observation_is_refused(path):
    saved = NumpyPolicy.load(path)
    other = replace(saved, observation=("0:2 robot pelvis x, y (world) [m]", *saved.observation[1:]))
    with pytest.raises(ValueError, match="observes 0:2 robot pelvis x, y"):
        learner_policy(other)


def test_another_bound_on_the_inputs_is_refused(path):
    saved = NumpyPolicy.load(path)
    assert learner_policy(replace(saved, clip=normalizer.CLIP))
    with pytest.raises(ValueError, match="bounds its inputs at 5 standard deviations, this version at 10; use the"):
        learner_policy(replace(saved, clip=5.0))


def test_wrong_inputs_are_refused(path, tmp_path):
    with pytest.raises(ValueError, match=r"shape \(79,\) was given; this policy takes 80"):
        NumpyPolicy.load(path)(np.zeros(79))
    with pytest.raises(ValueError, match="There is no policy file"):
        NumpyPolicy.load(tmp_path / "missing.npz")


@pytest.mark.parametrize("local", ["1x", "1x/best.npz"])
def test_a_name_of_ours_that_is_here_as_well_is_refused(path, tmp_path, monkeypatch, local):
    shipped = shipped_policies()["1x"]
    monkeypatch.chdir(tmp_path)
    assert policy_path("1x") == shipped
    assert policy_path("here") is None
    there = tmp_path / local
    there.parent.mkdir(exist_ok=True)
    assert policy_path("1x") == shipped
    path.rename(there)
    with pytest.raises(ValueError, match=f"^1x comes with .*, as {local}; write ./1x for the one here, or {shipped} "):
        policy_path("1x")
    assert policy_path("./1x") == Path(local)
    assert policy_path(str(shipped)) == shipped


def test_export_copies_a_checked_policy(path, tmp_path, capsys):
    path.rename(tmp_path / "best.npz")
    export_command.main(ExportConfig(run=str(tmp_path), out=str(tmp_path / "mine.npz")))
    assert "return_weighted 250.0" in capsys.readouterr().out
    assert NumpyPolicy.load(tmp_path / "mine.npz").provenance == {"return_weighted": 250.0, "commit": "abc"}
    with pytest.raises(ValueError, match="choose one of best, last"):
        export_command.main(ExportConfig(run=str(tmp_path), out=str(tmp_path / "a.npz"), which="first"))
