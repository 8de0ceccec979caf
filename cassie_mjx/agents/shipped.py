"""The policies that come with the package, and where a policy of any name is; NumPy alone."""

from pathlib import Path

from cassie_mjx.agents.numpy_policy import NumpyPolicy

FOLDER = Path(__file__).parent / "policies"


def shipped_policies() -> dict[str, Path]:
    """Files of the trained policies that come with the package, by name."""
    return {path.stem: path for path in sorted(FOLDER.glob("*.npz"), key=lambda path: path.stem)}


def policy_path(name: str) -> Path | None:
    """The policy we ship as `name`, the file `name`, or the best policy of the run in that directory; None if none.

    Raises:
      ValueError: there is such a file or run, and we ship a policy of the same name.
    """
    path = Path(name) / "best.npz" if Path(name).is_dir() else Path(name)
    shipped, local = shipped_policies().get(name), path if path.is_file() else None
    if shipped and local:
        raise ValueError(
            f"{name} comes with the package and is here as well, as {local}; write ./{name} for the one here, or "
            f"{shipped} for the other."
        )
    return shipped or local


def existing_policy(name: str, key: str = "policy") -> Path:
    """The file of the policy that we ship as `name`, of the file `name`, or of the best one of the run there.

    Args:
      name: of the policy.
      key: of the command line, for the sentence.

    Raises:
      ValueError: there is none, or two.
    """
    path = policy_path(name)
    if path is None:
        known = ", ".join(shipped_policies())
        raise ValueError(f"{key}={name} is none of {known}, nor a policy's .npz file, nor a run's directory.")
    return path


def load_policy(name: str | Path) -> NumpyPolicy:
    """The policy that we ship as `name`, of the file `name`, or the best one of the run in that directory.

    Raises:
      ValueError: there is none, or two, or its file is damaged.
    """
    return NumpyPolicy.load(existing_policy(str(name)))
