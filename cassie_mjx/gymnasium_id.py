"""The id of Gymnasium's views, known to Gymnasium as soon as both packages are imported, whichever comes first.

Gymnasium 1.0 and later asks no package for its environments. It is not imported here, for it takes time and few need
it: where it is not there yet, its import is waited for.
"""

import importlib.util
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType

ID = "CassieMJX/Walk-v0"
_VIEWS = "cassie_mjx.envs.gymnasium_env"


def announce() -> None:
    """Register the id with Gymnasium, now or when it is imported."""
    if gymnasium := sys.modules.get("gymnasium"):
        _register(gymnasium)
    else:
        # Before the finders that would find it.
        sys.meta_path.insert(0, _Waiting())


def _register(gymnasium: ModuleType) -> None:
    """What is registered is where the views are; they are imported when one is made."""
    one, many = f"{_VIEWS}:GymnasiumEnv", f"{_VIEWS}:GymnasiumVectorEnv"
    gymnasium.register(ID, entry_point=one, vector_entry_point=many)


class _Waiting:
    """A finder of modules that leaves finding to the others, and registers the id once Gymnasium is imported."""

    def __init__(self) -> None:
        self._asked = False

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != "gymnasium" or self._asked:
            return None
        self._asked = True
        try:
            spec = importlib.util.find_spec(fullname)
        finally:
            self._asked = False
        if spec and spec.loader:
            execute = spec.loader.exec_module

            def exec_module(module: ModuleType) -> None:
                execute(module)
                _register(module)

            spec.loader.exec_module = exec_module
        return spec
