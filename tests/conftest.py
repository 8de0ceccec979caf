import json
from pathlib import Path

import jax
import pytest

from cassie_mjx.model import ModelConfig, load, standing

ROOT = Path(__file__).parents[1]
jax.config.update("jax_compilation_cache_dir", str(ROOT / ".cache" / "jax"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)


@pytest.fixture(scope="session")
def figures():
    return json.loads((ROOT / "tests" / "cassie_figures.json").read_text())


@pytest.fixture(scope="session")
def model():
    return load(ModelConfig())


@pytest.fixture(scope="session")
def standing_qpos(model):
    return standing(model)
