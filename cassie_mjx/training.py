"""What a training run is made of: its configuration, its engine, its state, and one iteration of it."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from cassie_mjx import devices, diagnosis, export, robot
from cassie_mjx.config import PPO_PRESETS, PPOConfig, speed_factors
from cassie_mjx.envs import observation
from cassie_mjx.envs.walk import ENDS, WALK_PRESETS, WalkConfig, WalkEnv
from cassie_mjx.metrics import Stopwatch
from cassie_mjx.model import MJX_TRAINING, ModelConfig, load, load_for_mjx, steps_per_control
from cassie_mjx.numpy_policy import NumpyPolicy
from cassie_mjx.physics.mjx import MjxPhysics
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.ppo import learner, rollout
from cassie_mjx.ppo.types import LearnerState, Policy, UpdateMetrics
from cassie_mjx.reference import ReferenceMotion

# Rates that training is stable and fast at, Hz; every return is measured at 2 kHz.
TRAINING_HZ = {"native": 500, "mjx": 1000}

PRESETS = {"walk": ("undisturbed", WALK_PRESETS), "ppo": ("parallel", PPO_PRESETS)}
"""Presets that a command line can choose from, and which is the default."""


@dataclass(frozen=True)
class TrainConfig:
    """A training run."""

    speed: str = "1x"
    """Factor on the pelvis x of the reference motion, from "0x" to "4x"; "any" commands one after another."""
    physics: str = "auto"
    """"native": MuJoCo C on CPU threads; "mjx"; "auto": MJX if there is an accelerator."""
    physics_hz: int | None = None
    """Physics steps a second in training; null for 500 on MuJoCo C and 1000 on MJX."""
    seed: int = 0
    """What all random numbers of the run come from."""
    reference: str = "walk"
    """Reference motion: a name that we ship, or a file."""
    init: str | None = None
    """Policy to start from, with its input statistics: one that we ship, a .npz file, or a run's directory (its best);
    null for none. Critic, optimiser and noise start anew."""
    walk: WalkConfig = field(default_factory=WalkConfig)
    """The task."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """The learner: a preset (ppo=paper) and single values (ppo.gamma=0.98)."""
    evaluate_every: int = 10
    """Iterations between measurements of the return; each is followed by a checkpoint."""
    run_dir: str | None = None
    """Directory of the run; null for runs/<speed>-seed<seed>."""
    resume: bool = False
    """Whether to go on with the run that `run_dir` holds, if it holds one."""
    distributed: bool = False
    """Whether this is one of several processes of a cluster that train together, on MJX."""

    def __post_init__(self) -> None:
        """Raise ValueError for a value out of range."""
        speed_factors(self.speed)
        if self.physics not in ("auto", *TRAINING_HZ):
            raise ValueError(f"physics={self.physics} is not known; choose one of auto, {', '.join(TRAINING_HZ)}.")
        if self.physics_hz is not None:
            steps_per_control(self.physics_hz)
        if self.evaluate_every < 1:
            raise ValueError(f"evaluate_every={self.evaluate_every} must be at least 1.")
        if not 0 <= self.seed < 2**32:
            raise ValueError(f"seed={self.seed} must be from 0 to 2^32 - 1.")


class RunState(NamedTuple):
    """Everything that one iteration hands to the next."""

    learner: LearnerState
    env: Any
    key: jax.Array
    """Data of the key that the keys of all iterations are folded from."""


class IterationMetrics(NamedTuple):
    """Scalars of one iteration."""

    update: UpdateMetrics
    ends: dict[str, jax.Array]
    """Episodes that ended by each of `walk.ENDS`; one may have ended by several."""


def resolve(config: TrainConfig) -> TrainConfig:
    """The configuration with nothing left to choose: engine, rate and directory.

    Raises:
      ValueError: the engine cannot use several processes, or the sizes do not divide among the devices.
    """
    accelerated = config.physics == "auto" and jax.default_backend() != "cpu"
    physics = ("mjx" if accelerated else "native") if config.physics == "auto" else config.physics
    if physics == "mjx":
        learner.check_devices(config.ppo, jax.device_count())
    elif jax.process_count() > 1:
        raise ValueError("physics=native runs in one process; choose physics=mjx to train with several.")
    return replace(
        config,
        physics=physics,
        physics_hz=config.physics_hz or TRAINING_HZ[physics],
        run_dir=config.run_dir or f"runs/{config.speed}-seed{config.seed}",
    )


def initial_policy(config: TrainConfig) -> Policy | None:
    """The policy that `config.init` names, if it names one.

    Raises:
      ValueError: there is none, or two; its file is damaged, or its layers or inputs are not those of this run, or it
        is symmetric and this run is not.
    """
    if config.init is None:
        return None
    path = export.find(config.init)
    if path is None:
        known = ", ".join(export.shipped_policies())
        raise ValueError(f"init={config.init} is none of {known}, nor a policy's .npz file, nor a run's directory.")
    saved = NumpyPolicy.load(path)
    widths = tuple(len(bias) for _, bias in saved.weights[:-1])
    if widths != config.ppo.hidden_sizes:
        raise ValueError(f"init={config.init} has hidden layers of {list(widths)}; set ppo.hidden_sizes to that.")
    if saved.mirror and not config.walk.symmetric:
        raise ValueError(f"init={config.init} learned one step of the stride alone; set walk.symmetric=true.")
    return export.learner_policy(saved)


class Trainer:
    """The compiled or timed functions that a resolved configuration trains with."""

    def __init__(self, config: TrainConfig, motion: ReferenceMotion) -> None:
        """Make the environment; on MuJoCo C, `watch` counts the time in `physics` and `learner`."""
        self.config, self.watch = config, Stopwatch()
        # Where each part of a `RunState` belongs, if there is a choice.
        self._places: Any = None
        update = partial(learner.update, config.ppo)
        model_hz = config.physics_hz or TRAINING_HZ[config.physics]
        disturbance, damping = config.walk.disturbance, config.walk.damping
        max_delay = disturbance.delay_steps(model_hz)
        _, speeds = speed_factors(config.speed)
        if config.physics == "mjx":
            physics = MjxPhysics(load_for_mjx(replace(MJX_TRAINING, physics_hz=model_hz)), max_delay, damping)
            self.env = WalkEnv(physics, motion, config.walk, config.ppo.num_robots, speeds)
            self.collect = partial(rollout.collect, self.env.step, config.ppo)
            if jax.device_count() > 1:
                self.collect, update = devices.on_all(self.collect, update)
                same: Any = devices.same_everywhere()
                self._places = RunState(same, devices.split_by_robot(), same)
            # One compiled call an iteration. Left to itself, XLA moves empty arrays, and the next call compiles again.
            self.iterate = jax.jit(partial(iterate, self.collect, update), out_shardings=(self._places, None))
        else:
            model = load(ModelConfig(physics_hz=model_hz, scene="terrain" if disturbance.terrain_m else "flat"))
            physics = _TimedPhysics(NativePhysics(model, max_delay, damping=damping), self.watch)
            self.env = WalkEnv(physics, motion, config.walk, config.ppo.num_robots, speeds)
            self.collect = partial(rollout.collect_on_host, self.env.step, config.ppo)
            self.iterate = partial(iterate, self.collect, self.watch.timed("learner", update))

    @property
    def physics_steps(self) -> int:
        """Physics steps of all robots in one iteration."""
        return self.config.ppo.num_samples * steps_per_control(round(1 / self.env.physics.model.opt.timestep))

    def start(self, policy: Policy | None = None) -> RunState:
        """An untrained learner, or one with this policy, and robots at the start of an episode.

        Without a policy the learner knows no input statistics yet; see `gather_statistics`.
        """
        init_key, reset_key, _, run_key = self._keys()
        env_state = self.env.reset(reset_key)
        sizes = (observation.SIZE, robot.NU, env_state.privileged.shape[-1])
        state = learner.init(init_key, self.config.ppo, *sizes)
        if policy is not None:
            state = state._replace(policy=policy._replace(std=state.policy.std))
        if self.config.physics == "mjx":
            env_state = jax.tree.map(jnp.asarray, env_state)
        return self._placed(RunState(state, env_state, jax.random.key_data(run_key)))

    def gather_statistics(self, run: RunState) -> RunState:
        """The run with the input statistics of the states that a random policy visits."""
        _, _, statistics_key, _ = self._keys()
        policy, samples = run.learner.policy, self.config.ppo.normalizer_samples
        normalizer = rollout.random_policy_statistics(self.collect, policy, run.env, statistics_key, samples)
        return self._placed(run._replace(learner=run.learner._replace(policy=policy._replace(normalizer=normalizer))))

    def _placed(self, run: RunState) -> RunState:
        return run if self._places is None else jax.device_put(run, self._places)

    def replay(self, before: RunState) -> diagnosis.Divergence | None:
        """What led to the first divergence of the physics in the iteration that began with `before`.

        Every process must call it, and finds the same.
        """
        before = before._replace(learner=devices.own_copy(before.learner), key=devices.own_copy(before.key))
        collect_key, _ = iteration_keys(before)
        shares = [(before.env, collect_key)] if self._places is None else devices.shares(before.env, collect_key)
        found = (diagnosis.replay(self.env, self.config.ppo, before.learner.policy, *share) for share in shares)
        return next(filter(None, found), None)

    def _keys(self) -> jax.Array:
        return jax.random.split(jax.random.key(self.config.seed), 4)


def iterate(
    collect: rollout.Collect, update: Callable[..., tuple[LearnerState, UpdateMetrics]], run: RunState
) -> tuple[RunState, IterationMetrics]:
    """Collect experience with the present policy and learn from it."""
    collect_key, update_key = iteration_keys(run)
    env_state, experience = collect(run.learner.policy, run.env, collect_key)
    state, metrics = update(run.learner, experience, update_key)
    ends = {name: experience.metrics[name].sum() for name in ENDS}
    return RunState(state, env_state, run.key), IterationMetrics(metrics, ends)


def iteration_keys(run: RunState) -> jax.Array:
    """The keys of the iteration that begins with `run`: to collect with, and to update with."""
    return jax.random.split(jax.random.fold_in(jax.random.wrap_key_data(run.key), run.learner.iteration))


class _TimedPhysics:
    """An engine whose time in `advance` is counted under "physics"."""

    def __init__(self, physics: NativePhysics, watch: Stopwatch) -> None:
        self.model, self.max_delay, self.damping = physics.model, physics.max_delay, physics.damping
        self.init, self.bodies = physics.init, physics.bodies
        self.advance = watch.timed("physics", physics.advance)
