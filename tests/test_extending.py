"""docs/extending.md: every section, applied to a copy of the package, does what it says."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests import tiny

ROOT = Path(__file__).parents[1]
_, *SECTIONS = re.split(r"^## ", (ROOT / "docs" / "extending.md").read_text(), flags=re.M)
BLOCK = re.compile(r'^```(\w+)(?: title="([^"\n]*)")?\n(.*?)^```$', re.M | re.S)


def names(section):
    return section.partition("\n")[0]


def apply(diff, root):
    """Apply the hunks of a diff: what they remove, with its context, is in its file once."""
    changed = []
    for part in re.split(r"^--- ", diff, flags=re.M)[1:]:
        path, _, hunks = part.partition("\n")
        text = (root / path).read_text()
        for hunk in re.split(r"^@@\n", hunks, flags=re.M)[1:]:
            lines = [(line[:1] or " ", line[1:]) for line in hunk.splitlines()]
            before, after = ("".join(f"{line}\n" for sign, line in lines if sign in kept) for kept in (" -", " +"))
            assert text.count(before) == 1, f"{path} has this {text.count(before)} times:\n{before}"
            text = text.replace(before, after)
        (root / path).write_text(text)
        changed.append(path)
    return changed


def run(command, root):
    cache = {"JAX_COMPILATION_CACHE_DIR": str(ROOT / ".cache" / "jax")}
    environment = {**os.environ, **cache, "PYTHONPATH": str(root)}
    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{shlex.join(command)}\n{done.stdout}\n{done.stderr}"


def run_block(kind, text, root):
    if kind == "python":
        run([sys.executable, "-c", text], root)
        return
    for command in text.splitlines():
        program, *words = shlex.split(command)
        assert (kind, program) == ("sh", "python")
        run([sys.executable, *words, *(tiny.ARGUMENTS if "cassie_mjx.train" in words else ())], root)


def add(section, root, run_too):
    """Follow a section in a copy of the package; the files that changed."""
    for folder in ("cassie_mjx", "experiments", "xml"):
        shutil.copytree(ROOT / folder, root / folder, ignore=shutil.ignore_patterns("__pycache__", "results"))
    changed = []
    for kind, title, text in BLOCK.findall(section):
        if kind == "diff":
            changed += apply(text, root)
        elif title:
            assert not (root / title).exists()
            (root / title).write_text(text)
            changed.append(title)
        elif run_too:
            run_block(kind, text, root)
    return changed


@pytest.mark.parametrize("section", SECTIONS, ids=names)
def test_a_section_changes_the_files_that_it_lists(section, tmp_path):
    listed = section[section.index("Files: ") :].partition("\n\n")[0]
    changed = add(section, tmp_path, run_too=False)
    assert sorted(changed) == sorted(re.findall(r"`(.*?)`", listed))
    for path in changed:
        compile((tmp_path / path).read_text(), path, "exec")


@pytest.mark.slow
@pytest.mark.parametrize("section", SECTIONS, ids=names)
def test_what_a_section_adds_works(section, tmp_path):
    add(section, tmp_path, run_too=True)
