"""A frozen dataclass as a Hydra command line: config groups, sweeps with -m, every mistake one sentence."""

import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import FrozenInstanceError
from typing import Any, TypeVar

import hydra
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from cassie_mjx.cli.command_line import keep_compiled_programs

C = TypeVar("C")

# Hydra keeps its own folders and log files to itself: a run's directory is the run's own business.
_QUIET = {
    "output_subdir": None,
    "run": {"dir": "."},
    "sweep": {"dir": "runs", "subdir": "."},
    "job": {"chdir": False},
}


def run(
    main: Callable[[C], None], config_class: type[C], name: str, groups: Mapping[str, tuple[str, Mapping[str, Any]]]
) -> None:
    """Run a command: `sys.argv` as Hydra reads it, then `main` for each combination of values.

    A ValueError or OSError from `main`, and whatever Hydra objects to, ends it with one sentence and status 2.

    Args:
      main: takes a whole configuration.
      config_class: frozen dataclass; its fields are the keys.
      name: of the configuration, as `--help` shows it.
      groups: field name to (default choice, choices): presets of a field that is a dataclass itself.
    """
    _register(config_class, name, groups)
    # Hydra then raises what it would print in several lines.
    os.environ["HYDRA_FULL_ERROR"] = "1"

    # All configuration is in dataclasses: a path of our own would make each package beside this file a config group.
    @hydra.main(version_base="1.3", config_path="pkg://hydra.conf", config_name=name)
    def task(config: DictConfig) -> None:
        # Here, for a launcher may have taken the task to another process.
        keep_compiled_programs()
        try:
            main(OmegaConf.to_object(config))  # type: ignore[arg-type]
        except FrozenInstanceError as error:
            _exit(ValueError(f"A key with + in front must exist as well: {error}."))
        except (ValueError, OSError, OmegaConfBaseException) as error:
            _exit(error)

    try:
        task()
    except (HydraException, OmegaConfBaseException) as error:
        _exit(error)


def sentence(error: Exception) -> str:
    """What `error` says, in one line; for a key or a choice that does not exist, which ones do."""
    cause = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else error
    if isinstance(cause, OmegaConfBaseException):
        if isinstance(cause, (ConfigAttributeError, ConfigKeyError)) and isinstance(cause.parent_node, DictConfig):
            keys = ", ".join(str(key) for key in cause.parent_node if key != "hydra")
            return f"{cause.full_key!r} is not a key; the keys are {keys}."
        return f"{cause.full_key}: {str(cause).splitlines()[0]}."
    if isinstance(error, MissingConfigException) and error.options:
        choice = "=".join(str(error.missing_cfg_file).rsplit("/", 1))
        return f"{choice} is not known; choose one of {', '.join(error.options)}."
    if isinstance(error, OverrideParseException):
        return f"{error.override!r} is not of the form key=value."
    return " ".join(str(error).split())


def _register(config_class: type, name: str, groups: Mapping[str, tuple[str, Mapping[str, Any]]]) -> None:
    store = ConfigStore.instance()
    store.store(name=f"{name}_schema", node=_writable(config_class))
    for group, (_, choices) in groups.items():
        for choice, node in choices.items():
            store.store(group=group, name=choice, node=_writable(node))
    defaults = [f"{name}_schema", *({group: default} for group, (default, _) in groups.items()), "_self_"]
    quiet = [{"override hydra/job_logging": "disabled"}, {"override hydra/hydra_logging": "disabled"}]
    program = {"help": {"app_name": f"python -m cassie_mjx.{name}"}}
    store.store(name=name, node={"defaults": [*defaults, *quiet], "hydra": _QUIET | program})


def _writable(config: Any) -> DictConfig:
    """The schema of a frozen dataclass, into which Hydra may merge before `OmegaConf.to_object` freezes the result."""
    node = OmegaConf.structured(config)
    _unfreeze(node)
    return node


def _unfreeze(node: DictConfig) -> None:
    OmegaConf.set_readonly(node, None)
    for value in node.values():
        if isinstance(value, DictConfig):
            _unfreeze(value)


def _exit(error: Exception) -> None:
    print(f"error: {sentence(error)}", file=sys.stderr)
    sys.exit(2)
