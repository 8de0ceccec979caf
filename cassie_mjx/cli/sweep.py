"""All combinations of values, `-m seed=0,1`: one job after another, or as a launcher of Hydra's spreads them."""

import os
import sys
from collections.abc import Callable, Sequence

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

# Hydra keeps its own folders and log files to itself: a run's directory is the run's own business.
_QUIET = {
    "output_subdir": None,
    "run": {"dir": "."},
    "sweep": {"dir": "runs", "subdir": "."},
    "job": {"chdir": False},
}
# Hydra sees keys without dots, for a key may have a preset and settings of its own.
_DOT = "__"


def sweep(arguments: Sequence[str], job: Callable[[list[str]], None]) -> None:
    """Call `job` with the arguments of each combination; keys that begin with hydra are Hydra's.

    Raises:
      ValueError: what Hydra objects to, or a job.
    """
    own = [argument for argument in arguments if not argument.startswith(("hydra.", "hydra/"))]
    hydras = [argument for argument in arguments if argument not in own]
    if wrong := [argument for argument in own if "=" not in argument]:
        raise ValueError(f"{wrong[0]!r} is not of the form key=value.")
    encoded = [f"+{key.replace('.', _DOT)}={value}" for key, _, value in (each.partition("=") for each in own)]
    defaults = [{"override hydra/job_logging": "disabled"}, {"override hydra/hydra_logging": "disabled"}]
    ConfigStore.instance().store(name="sweep", node={"defaults": ["_self_", *defaults], "hydra": _QUIET})
    # Hydra then raises what it would print in several lines.
    os.environ["HYDRA_FULL_ERROR"] = "1"

    # The job reads its own configuration: a path of our own would make each package beside this file a config group.
    @hydra.main(version_base="1.3", config_path="pkg://hydra.conf", config_name="sweep")
    def task(_: DictConfig) -> None:
        overrides = [override.removeprefix("+") for override in HydraConfig.get().overrides.task]
        split = [override.partition("=") for override in overrides]
        job([f"{key.replace(_DOT, '.')}={value}" for key, _, value in split])

    before = sys.argv
    sys.argv = [before[0], "-m", *encoded, *hydras]
    try:
        task()
    except OverrideParseException as error:
        raise ValueError(f"{error.override!r} is not of the form key=value.") from error
    except MissingConfigException as error:
        choice = "=".join(str(error.missing_cfg_file).rsplit("/", 1))
        raise ValueError(f"{choice} is not known; choose one of {', '.join(error.options or ())}.") from error
    except (HydraException, OmegaConfBaseException) as error:
        raise ValueError(" ".join(str(error).split())) from error
    finally:
        sys.argv = before
