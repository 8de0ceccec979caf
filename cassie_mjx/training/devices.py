"""Data parallelism: the robots split over all devices of all hosts, the learner the same on each of them.

With several hosts, each runs the same program in a process of its own on arrays that span them all. Every process must
reach the functions below that say so; the first process alone writes files and speaks.
"""

import os
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Key

from cassie_mjx.ppo.rollout import Collect
from cassie_mjx.ppo.types import LearnerState, Policy, Rollout, UpdateMetrics

AXIS = "devices"

T = TypeVar("T")

Update = Callable[..., tuple[LearnerState, UpdateMetrics]]

_SAME, _ROBOTS, _STEPS_AND_ROBOTS = PartitionSpec(), PartitionSpec(AXIS), PartitionSpec(None, AXIS)


def join() -> None:
    """Join the other processes that the cluster has started for the same command.

    Raises:
      ValueError: there is no cluster that JAX knows.
    """
    if jax.distributed.is_initialized():
        return
    try:
        jax.distributed.initialize()
    except ValueError as error:
        raise ValueError(
            f"distributed=true found no other processes ({error}) Start the command with srun or mpirun."
        ) from error


def accelerator() -> str | None:
    """What JAX calls the accelerator that it computes on by itself; None if it has only the CPU."""
    # On few cores, XLA's threads take time from the physics' threads; it reads this when it first looks for devices.
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
    return None if jax.default_backend() == "cpu" else jax.local_devices()[0].device_kind


def is_first() -> bool:
    """Whether this is the process that writes files and speaks."""
    return jax.process_index() == 0


def exchange(value: int) -> list[int]:
    """What each process has, 0 to 2^32 - 1; every process must call it, and waits here for the others."""
    return [value] if jax.process_count() == 1 else multihost_utils.process_allgather(np.uint32(value)).tolist()


def same_everywhere() -> NamedSharding:
    """Where arrays belong that every device has a copy of."""
    return NamedSharding(_mesh(), _SAME)


def split_by_robot() -> NamedSharding:
    """Where arrays belong whose first axis counts robots."""
    return NamedSharding(_mesh(), _ROBOTS)


def on_all(collect: Collect, update: Update) -> tuple[Collect, Update]:
    """Both halves of an iteration on all devices at once, each device with its share of the robots.

    Args:
      collect: draws from its key what happens to the robots; each device gets a key of its own.
      update: `ppo.learner.update` with its configuration bound; each device gets the same key and makes the same step.
    """

    def collect_share(policy: Policy, env_state: Any, key: Key[Array, ""]) -> tuple[Any, Rollout]:
        return collect(policy, env_state, jax.random.fold_in(key, jax.lax.axis_index(AXIS)))

    spread = partial(jax.shard_map, mesh=_mesh(), check_vma=False)
    return (
        jax.jit(spread(collect_share, in_specs=(_SAME, _ROBOTS, _SAME), out_specs=(_ROBOTS, _STEPS_AND_ROBOTS))),
        spread(partial(update, axis_name=AXIS), in_specs=(_SAME, _STEPS_AND_ROBOTS, _SAME), out_specs=_SAME),
    )


def shares(env_state: T, key: Key[Array, ""]) -> list[tuple[T, Key[Array, ""]]]:
    """The robots and the key of each device in `on_all`, for this process alone; every process must call it."""
    count, whole = jax.device_count(), jax.tree.map(np.asarray, gather(env_state))
    return [(jax.tree.map(partial(_share, count, i), whole), jax.random.fold_in(key, i)) for i in range(count)]


def own_copy(tree: T) -> T:
    """This process' copy of arrays that are the same everywhere."""
    return jax.tree.map(lambda x: x.addressable_data(0), tree)


def gather(tree: T) -> T:
    """Arrays that every process can read to the end; every process must call it."""
    return tree if jax.process_count() == 1 else multihost_utils.process_allgather(tree, tiled=True)


def _share(count: int, i: int, whole: np.ndarray) -> jax.Array:
    return jnp.asarray(np.split(whole, count)[i])


def _mesh() -> Mesh:
    return jax.make_mesh((jax.device_count(),), (AXIS,), axis_types=(AxisType.Auto,))
