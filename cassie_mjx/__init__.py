"""Cassie MJX: a massively parallel training pipeline for the Cassie biped, on MJX and on MuJoCo C.

What stands here is the public interface; everything is imported when it is first used. `NumpyPolicy` and `Controller`
need NumPy alone.
"""

from cassie_mjx import starting

# Before the other imports, for Ctrl-C may come in them.
starting.begin("cassie_mjx")

import os  # noqa: E402
from importlib import import_module  # noqa: E402
from typing import TYPE_CHECKING, Any  # noqa: E402

from cassie_mjx import gymnasium_id  # noqa: E402

# XLA on CPU calls every program that it loads from the compilation cache a possible mismatch, in pages of CPU features
# (it compares with features that it added itself), so only what is fatal is shown; errors still raise.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

gymnasium_id.announce()

if TYPE_CHECKING:
    from cassie_mjx.agents.controller import Controller as Controller
    from cassie_mjx.agents.make import make_agent as make_agent
    from cassie_mjx.agents.numpy_policy import NumpyPolicy as NumpyPolicy
    from cassie_mjx.agents.shipped import load_policy as load_policy
    from cassie_mjx.envs.make import make_env as make_env
    from cassie_mjx.evaluation.suites import evaluate_agent as evaluate_agent
    from cassie_mjx.motion.files import load_motion as load_motion
    from cassie_mjx.motion.reference import ReferenceMotion as ReferenceMotion
    from cassie_mjx.training.config import TrainConfig as TrainConfig
    from cassie_mjx.training.runner import train_policy as train_policy

_PLACES = {
    "Controller": "agents.controller",
    "NumpyPolicy": "agents.numpy_policy",
    "ReferenceMotion": "motion.reference",
    "TrainConfig": "training.config",
    "evaluate_agent": "evaluation.suites",
    "load_motion": "motion.files",
    "load_policy": "agents.shipped",
    "make_agent": "agents.make",
    "make_env": "envs.make",
    "train_policy": "training.runner",
}

__all__ = list(_PLACES)


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"cassie_mjx has no {name!r}; it has {', '.join(sorted(_PLACES))}.")
    return getattr(import_module(f"cassie_mjx.{_PLACES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_PLACES])
