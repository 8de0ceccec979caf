"""Heuristic walkers and policies as subjects, and the names they go by."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cassie_mjx import cli, export, film, reference, returns, robot, subjects
from cassie_mjx.config import PPO_PRESETS
from cassie_mjx.envs import observation
from cassie_mjx.export import save_policy
from cassie_mjx.numpy_policy import NumpyPolicy
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.ppo import learner
from cassie_mjx.subjects import BlendSubject, ControllerSubject, PolicySubject, SubjectConfig
from cassie_mjx.sweeps import fly
from cassie_mjx.trials import Trial, Walker


def test_the_controller_starts_along_its_stride_and_walks_on(model):
    physics, subject = NativePhysics(model), ControllerSubject("stiff")
    phases = np.array([0.0, 0.25, 0.5, 0.875])
    starts = subject.start(physics, phases)
    np.testing.assert_allclose(starts.physics.qpos[:, 0], 0, atol=1e-12)
    # At phase 0 the clock of the right leg's step is over, and the next call gives the left leg its turn.
    memory = starts.memory.state
    off_phase = (memory.stance * 0.352 + memory.phase - 0.704 * phases + 0.1) % 0.704 - 0.1
    np.testing.assert_allclose(off_phase, 0, atol=1e-3)
    # The foot in the air, or about to leave the ground, left it within half a stride of the pelvis.
    assert (np.abs(memory.liftoff_w[:, 0]) < 0.5).all()
    result = fly(subject, physics, starts, [Trial(k, 3.0) for k in range(4)])
    assert not result.fell.any()
    np.testing.assert_allclose(result.distance_m / 3.0, 0.7, atol=0.07)
    moved = subject.carried(starts.memory, np.tile([1.0, 2.0, 3.0], (4, 1))).state
    np.testing.assert_allclose(moved.liftoff_w - memory.liftoff_w, np.tile([1, 2, 3], (4, 1)), atol=1e-6)
    np.testing.assert_allclose(moved.line_w - memory.line_w, np.tile([1, 2, 0], (4, 1)), atol=1e-6)


@pytest.mark.parametrize("name", ["stiff", "controller:soft", "runs/none"])
def test_an_unknown_policy_gets_one_sentence(name):
    known = "0x, 1x, 1x-robust, 2x, 3x, 4x, any, controller:stiff, controller:compliant"
    with pytest.raises(ValueError, match=f"policy={name} is none of {known}, nor"):
        subjects.resolve(name)


def test_a_policy_walks_as_its_targets_say(tmp_path, model):
    """A zero residual holds the next sample of the reference: the PD targets of `act`, step after step."""
    motion = reference.resolve("walk")
    state = learner.init(jax.random.key(0), PPO_PRESETS["parallel"], observation.SIZE, robot.NU, 1)
    zero = state.policy._replace(actor=jax.tree.map(jnp.zeros_like, state.policy.actor))
    save_policy(tmp_path / "zero.npz", zero, motion, 1.0, 0.5, {})
    subject = subjects.resolve(str(tmp_path / "zero.npz"))
    assert subject.damping == 0.5
    physics = NativePhysics(model)
    walker = Walker(physics.init(np.asarray(motion.qpos[[3, 21]]), np.asarray(motion.qvel[[3, 21]])), np.array([3, 21]))
    target, memory = subject.act(physics, walker.physics, walker.memory)
    np.testing.assert_allclose(target, np.asarray(motion.qpos)[[4, 0]][:, robot.ACTIVE_QPOS], atol=1e-6)
    np.testing.assert_array_equal(memory, [4, 0])
    with pytest.raises(ValueError, match="falls before it walks steadily"):
        subject.start(physics, np.zeros(1))


def test_a_policy_that_we_ship_goes_by_its_name():
    subject = subjects.resolve("1x")
    assert subject.name == "1x"
    assert subject.provenance == NumpyPolicy.load(export.shipped_policies()["1x"]).provenance


def test_returns_are_of_senses_as_late_as_asked(model, monkeypatch):
    monkeypatch.setattr(returns, "EPISODE_STEPS", 40)
    subject, physics = subjects.resolve("1x"), NativePhysics(model, max_delay=40)
    (prompt, *_), (late, *_) = (subject.returns(physics, delay) for delay in (0, 40))
    assert (prompt.quantity, late.quantity) == ("return_plain", "return_plain")
    # 20 ms late, robots fall within a second.
    assert prompt.value > 39
    assert late.value < 30


def test_a_command_line_names_its_subject():
    assert cli.parse(SubjectConfig, []).subject().name == "1x"
    faster = cli.parse(SubjectConfig, ["policy=1x", "speed=2.5x"]).subject()
    assert faster.name == "1x speed=2.5x"
    assert isinstance(faster, PolicySubject)
    assert faster.motion.stride_length == pytest.approx(2.5 * reference.resolve("walk").stride_length, rel=1e-3)
    blend = cli.parse(SubjectConfig, ["policy=blend:1x,1x", "schedule=ramp"]).subject()
    assert blend.name == "blend:1x,1x schedule=ramp"


def test_a_film_of_a_blend_begins_where_its_ramp_does():
    blend = SubjectConfig("blend:1x,1x", schedule="ramp").subject()
    assert isinstance(blend, BlendSubject)
    _, walker = film.begin(blend, Trial(0, 1.0), phase=0.5)
    np.testing.assert_array_equal(walker.memory.step, [0])
    np.testing.assert_array_equal(blend.position(walker.memory), [0])
    np.testing.assert_array_equal(walker.memory.phase, [11])


def test_a_damaged_policy_gets_one_sentence(tmp_path):
    path = tmp_path / "policy.npz"
    path.write_bytes(export.shipped_policies()["1x"].read_bytes()[:-1000])
    with pytest.raises(ValueError, match="policy.npz is damaged"):
        subjects.resolve(str(path))


def test_a_policy_of_other_gains_gets_one_sentence(tmp_path):
    with np.load(export.shipped_policies()["1x"]) as archive:
        content = dict(archive)
    for name in ("p_gain", "d_gain"):
        changed = content[name] * np.where(np.arange(10) == 3, 0.5, 1.0)
        np.savez(tmp_path / "policy.npz", **(content | {name: changed}))
        with pytest.raises(ValueError, match="PD gains other than the published ones with all D scaled alike"):
            subjects.resolve(str(tmp_path / "policy.npz"))


def test_a_policy_of_another_robot_gets_one_sentence(tmp_path):
    with np.load(export.shipped_policies()["1x"]) as archive:
        content = dict(archive)
    np.savez(tmp_path / "policy.npz", **(content | {"joints": content["joints"][::-1]}))
    with pytest.raises(ValueError, match="drives joints or imitates a motion that this version's robot has not"):
        subjects.resolve(str(tmp_path / "policy.npz"))
