"""All combinations of values, `-m seed=0,1`: one job after another, or as a launcher of Hydra's spreads them."""

import json
import os
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from types import NoneType
from typing import Any, get_args
from urllib.parse import quote, unquote

from cassie_mjx.cli.keys import Key
from cassie_mjx.cli.reading import values_of

# What asks Hydra for all combinations, or for its own configuration, which lists a launcher's options.
_FLAGS = {"-m", "--multirun", "-c", "--cfg"}
# Hydra keeps its own folders and log files to itself: a run's directory is the run's own business.
_QUIET = {
    "output_subdir": None,
    "run": {"dir": "."},
    "sweep": {"dir": "runs", "subdir": "."},
    "job": {"chdir": False},
}

Job = Callable[[list[str], dict[str, str]], None]
"""Does one combination, given its arguments and, of these, what not all combinations have in common."""


class CombinationFailed(Exception):
    """A combination of a sweep, the message, has failed, and has said why."""


def wants_hydra(arguments: Sequence[str]) -> bool:
    """Whether the arguments of a command line are for Hydra to read."""
    return bool(_FLAGS & set(arguments))


def is_hydras(argument: str) -> bool:
    """Whether an argument that Hydra reads is about Hydra itself, not one of the command's keys."""
    name, equals, _ = argument.partition("=")
    return not equals or name.startswith(("hydra.", "hydra/")) or name in ("--cfg", "--package")


def sweep(arguments: Sequence[str], keys: Mapping[str, Key], job: Job) -> None:
    """Call `job` for each combination; what it raises is printed, and the other combinations go on.

    Args:
      arguments: `key=values` of known keys, and what is for Hydra.
      keys: the command's.
      job: may be called in another process.

    Raises:
      ValueError: what Hydra objects to, or combinations failed; the sentence names them.
    """
    # Imported here: no other command line waits for it.
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException
    from omegaconf import DictConfig
    from omegaconf.errors import OmegaConfBaseException

    typed, here, failed = sys.argv, os.getpid(), []
    whole = [each if is_hydras(each) else _for_hydra(each, keys) for each in arguments]
    ours = [each for each in whole if each.startswith("++")]
    _set_up_hydra()

    # The job reads its own configuration: a path of our own would make each package beside this file a config group.
    @hydra.main(version_base="1.3", config_path="pkg://hydra.conf", config_name="sweep")
    def task(_: DictConfig) -> None:
        # A run's record and how to go on with it are of the command that was typed.
        sys.argv = typed
        own = OverridesParser.create().parse_overrides(list(HydraConfig.get().overrides.task))
        values = {str(each.key_or_group): _text(each.value()) for each in own}
        if name := _failure(job, values, {key: values[key] for key in swept}):
            failed.append(name)
            if os.getpid() != here:
                raise CombinationFailed(name)

    # ++ sets a key that Hydra's own configuration does not have.
    sys.argv = [typed[0], *whole]
    try:
        overrides = OverridesParser.create().parse_overrides(ours)
        swept = [str(each.key_or_group) for each in overrides if each.is_sweep_override()]
        task()
    except CombinationFailed as error:
        # A launcher that takes jobs to other processes brings back the first failure alone.
        raise ValueError(f"{error} failed, and maybe others; the launcher's logs say why.") from error
    except (HydraException, OmegaConfBaseException) as error:
        raise ValueError(_sentence(error)) from error
    finally:
        sys.argv = typed
    if failed:
        raise ValueError(f"{len(failed)} of the combinations failed: {'; '.join(failed)}.")


def _set_up_hydra() -> None:
    """Have Hydra know the configuration "sweep", and raise what it would print in several lines."""
    from hydra.core.config_store import ConfigStore

    defaults = [{"override hydra/job_logging": "disabled"}, {"override hydra/hydra_logging": "disabled"}]
    ConfigStore.instance().store(name="sweep", node={"defaults": ["_self_", *defaults], "hydra": _QUIET})
    os.environ["HYDRA_FULL_ERROR"] = "1"


def _for_hydra(argument: str, keys: Mapping[str, Key]) -> str:
    """The same argument as Hydra reads it, whatever is in its values."""
    name, _, text = argument.partition("=")
    kind = keys[name].kind
    # Numbers are Hydra's own: it has range(0,10).
    if {kind, *get_args(kind)} <= {int, float, bool, NoneType}:
        return f"++{name}={text}"
    return f"++{name}=" + ",".join(f"'{quote(value)}'" for value in values_of(argument, text, kind))


def _text(value: Any) -> str:
    """The text of a value that Hydra has read."""
    return unquote(value) if isinstance(value, str) else json.dumps(value)


def _failure(job: Job, values: Mapping[str, str], swept: dict[str, str]) -> str:
    """Do one combination. Which one it is if it fails, for a reason that is printed; else nothing."""
    try:
        job([f"{key}={value}" for key, value in values.items()], swept)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
    except Exception:
        traceback.print_exc()
    else:
        return ""
    return " ".join(f"{key}={value}" for key, value in (swept or values).items())


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
        return f"{argument!r} cannot be read by Hydra; give one value or several with commas between, in quotes, '...'."
    return " ".join(str(error).split())
