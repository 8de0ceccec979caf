import json
import signal
import sys
from pathlib import Path

import jax
import pytest
from absl import logging

from cassie_mjx.robot.model import ModelConfig, load_model, standing

ROOT = Path(__file__).parents[1]
# A shell's background job ignores Ctrl-C and nohup a hangup, and so would every process that a test starts and ends.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)
jax.config.update("jax_compilation_cache_dir", str(ROOT / ".cache" / "jax"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)
# Hydra closes all log handlers, and absl's closes its stream with it unless that is the process' own: pytest's capture.
logging.get_absl_handler().python_handler.stream = sys.__stderr__


@pytest.fixture(scope="session")
def figures():
    return json.loads((ROOT / "tests" / "cassie_figures.json").read_text())


@pytest.fixture(scope="session")
def model():
    return load_model(ModelConfig())


@pytest.fixture(scope="session")
def standing_qpos(model):
    return standing(model)
