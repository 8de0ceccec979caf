# Every target sets up .venv by itself; all it needs is make and Python 3.11 or newer.
PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin/python
# Of the page; it begins with joystick.
POLICIES := joystick 1x-robust 1x-sensors any 1x

.DEFAULT_GOAL := help
.PHONY: help setup train test test-all lint bench report site docs clean

help:            ## this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*##/:/'

$(VENV)/ready: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Cassie MJX needs Python 3.11 or newer; try make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	$(RUN) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

setup: $(VENV)/ready  ## the virtual environment in .venv

train: setup     ## train the 1x walk; other runs: make train ARGS='speed=2x seed=1'
	$(RUN) -m cassie_mjx.train $(ARGS)

test: setup      ## linters, types and tests
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .
	$(RUN) -m pyright --pythonpath $(RUN)
	$(RUN) -m pytest -n 2 --dist loadfile -m 'not slow'

test-all: setup  ## the same with the slow tests
	$(RUN) -m pytest

lint: setup      ## format the code and fix what can be fixed
	$(RUN) -m ruff format .
	$(RUN) -m ruff check --fix .

bench: setup     ## throughput of both engines on this machine
	$(RUN) -m experiments.throughput out=throughput.json

report: setup    ## report/index.html and the tables of README.md, docs/results.md and docs/evaluate.md, from experiments/results
	$(RUN) -m experiments.report out=report/index.html readme=README.md page=docs/results.md drives=docs/evaluate.md overwrite=true

site: setup      ## the page in which anyone drives Cassie, in docs/drive/; needs Node and npm
	@command -v npm > /dev/null || { echo "make site needs Node 18 or newer and npm: apt-get install nodejs npm." >&2; exit 1; }
	cd page && npm ci --ignore-scripts --no-audit --no-fund --loglevel=error
	rm -rf page/build && mkdir page/build
	for name in $(POLICIES); do $(RUN) -m cassie_mjx.export policy=$$name web=page/build || exit 1; done
	node page/build.mjs page/build docs/drive

docs: site       ## the guide as a site, in site/, and the page to drive Cassie in as a part of it
	$(RUN) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(RUN) -m mkdocs build --quiet --strict

clean:           ## remove the virtual environment, caches and what was built
	rm -rf $(VENV) .pytest_cache .ruff_cache dist site docs/drive page/build page/node_modules
