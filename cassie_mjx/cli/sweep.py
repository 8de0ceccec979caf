"""All combinations of values, `-m seed=0,1`: one job after another, or as a launcher of Hydra's spreads them."""

import json
import os
import sys
from collections.abc import Callable, Sequence

# What asks Hydra for all combinations, or for its own configuration, which lists a launcher's options.
_FLAGS = {"-m", "--multirun", "-c", "--cfg"}
# Hydra keeps its own folders and log files to itself: a run's directory is the run's own business.
_QUIET = {
    "output_subdir": None,
    "run": {"dir": "."},
    "sweep": {"dir": "runs", "subdir": "."},
    "job": {"chdir": False},
}


def wants_hydra(arguments: Sequence[str]) -> bool:
    """Whether the arguments of a command line are for Hydra to read."""
    return bool(_FLAGS & set(arguments))


def is_hydras(argument: str) -> bool:
    """Whether an argument that Hydra reads is about Hydra itself, not one of the command's keys."""
    return "=" not in argument or argument.startswith(("-", "hydra.", "hydra/"))


def sweep(arguments: Sequence[str], job: Callable[[list[str]], None]) -> None:
    """Call `job` with the arguments of each combination.

    Raises:
      ValueError: what Hydra objects to.
    """
    # Imported here: no other command line waits for it.
    import hydra
    from hydra.core.config_store import ConfigStore
    from hydra.core.hydra_config import HydraConfig
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException
    from omegaconf import DictConfig
    from omegaconf.errors import OmegaConfBaseException

    typed = sys.argv
    defaults = [{"override hydra/job_logging": "disabled"}, {"override hydra/hydra_logging": "disabled"}]
    ConfigStore.instance().store(name="sweep", node={"defaults": ["_self_", *defaults], "hydra": _QUIET})
    # Hydra then raises what it would print in several lines.
    os.environ["HYDRA_FULL_ERROR"] = "1"

    # The job reads its own configuration: a path of our own would make each package beside this file a config group.
    @hydra.main(version_base="1.3", config_path="pkg://hydra.conf", config_name="sweep")
    def task(_: DictConfig) -> None:
        # A run's record and how to go on with it are of the command that was typed.
        sys.argv = typed
        overrides = OverridesParser.create().parse_overrides(list(HydraConfig.get().overrides.task))
        # JSON is YAML, whatever is in a value.
        job([f"{each.key_or_group}={json.dumps(each.value(), ensure_ascii=False)}" for each in overrides])

    # ++ sets a key that Hydra's own configuration does not have.
    sys.argv = [typed[0], *(each if is_hydras(each) else f"++{each}" for each in arguments)]
    try:
        task()
    except (HydraException, OmegaConfBaseException) as error:
        raise ValueError(_sentence(error)) from error
    finally:
        sys.argv = typed


def _sentence(error: Exception) -> str:
    """What an error of Hydra's says, in one line."""
    from hydra.errors import MissingConfigException, OverrideParseException

    if isinstance(error, MissingConfigException) and error.options:
        choice = "=".join(str(error.missing_cfg_file).rsplit("/", 1))
        return f"{choice} is not known; choose one of {', '.join(error.options)}."
    if isinstance(error, OverrideParseException):
        argument = error.override.removeprefix("++")
        if "=" not in argument:
            return f"{argument!r} is not of the form key=value."
        return f"{argument!r} cannot be read by Hydra; put its value in quotes that the shell keeps, \"key='...'\"."
    return " ".join(str(error).split())
