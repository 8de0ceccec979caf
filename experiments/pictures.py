"""Pictures that experiments write: `plot=` and the like, whole or not at all."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.image import imsave

from cassie_mjx import cli
from cassie_mjx.files.atomic import replacing

_MARK = "made by cassie-mjx experiments"
# Where each format has a place for a sentence of ours.
_PLACES = {".png": "Comment", ".svg": "Description", ".pdf": "Keywords"}
PICTURE = cli.marked("a picture of ours", _MARK.encode())


def check(name: str, overwrite: bool, *others: Path) -> Path:
    """The file of a picture `name`; for the door.

    Args:
      name: what the command's key says.
      overwrite: the command's key of that name.
      others: what else the command writes.

    Raises:
      ValueError: its format is not known, it cannot be written, a file would be lost, or it is one of the others.
    """
    if Path(name).suffix not in _PLACES:
        raise ValueError(f"{name} is of no format for pictures; name a file that ends in {', '.join(_PLACES)}.")
    path = cli.check_output(name, PICTURE, overwrite)
    if path in others:
        raise ValueError(f"{name} is to be written twice; name another file.")
    return path


def save_figure(name: str, path: Path, figure: Figure, dpi: int = 90) -> None:
    """Write a figure, in the format of `name`, to what `check` made of it. Raises OSError that names the file."""
    with replacing(path) as partial:
        figure.savefig(partial, dpi=dpi, **_format(name))


def save_image(name: str, path: Path, pixels: np.ndarray) -> None:
    """Write pixels [height, width, 3], uint8, in the format of `name`, to what `check` made of it."""
    with replacing(path) as partial:
        imsave(partial, pixels, **_format(name))


def _format(name: str) -> dict[str, Any]:
    suffix = Path(name).suffix
    return {"format": suffix.removeprefix("."), "metadata": {_PLACES[suffix]: _MARK}}
