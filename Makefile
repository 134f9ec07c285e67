# quickstart: set up and train a small policy.  test, test-all, coverage, lint: check the code.  newest: test with the newest
# versions that pyproject.toml admits.  docs: build the site.  pictures: draw the pictures of the
# pages again (ARGS="--scans DIR …").  bench: install its peers, print the benchmark tables.
# Everything runs in .venv, which the first target makes; another interpreter: make quickstart PYTHON=python3.12

FAST := tests/test_architecture.py $(addprefix tests/common/,$(addsuffix .py,test_rotations test_motors test_priority \
  test_trajectories test_plausibility test_codec test_messages)) $(addprefix tests/learner/,$(addsuffix .py,test_losses \
  test_staleness test_limits))
supported := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do $$p -c '$(supported)' 2>/dev/null && echo $$p && break; done)
VENV := .venv
EXTRA ?= dev
CONSTRAINTS ?= constraints.txt
PIP := $(VENV)/bin/python -m pip --disable-pip-version-check
CACHE := $(or $(XDG_CACHE_HOME),$(HOME)/.cache)/congrasp

# Compiled programs are kept between runs; another folder: JAX_COMPILATION_CACHE_DIR=...
export JAX_COMPILATION_CACHE_DIR ?= $(CACHE)/jax
# Modules are compiled when they are first imported: an environment that forbids it would pay in every process again.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: quickstart test test-all newest check coverage lint docs pictures bench install clean
.DEFAULT_GOAL := quickstart

# What the first minutes need; the other targets add the development dependencies.
quickstart:
	$(MAKE) install EXTRA=viz
	$(VENV)/bin/congrasp train --preset quickstart

# Three workers on two cores: many tests wait for processes that they start or kill.
test test-all: install
	@tests/install_browser.sh $(VENV)/bin/python
	JAX_PLATFORMS=cpu $(VENV)/bin/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder -m "not gpu and not index$(if $(filter test,$@), and not slow)" $(ARGS)

newest:
	$(MAKE) test VENV=.venv-newest CONSTRAINTS=/dev/null

# Without processes, engines and pictures: about a minute.
check: lint
	JAX_PLATFORMS=cpu $(VENV)/bin/python -m pytest -q -n 3 $(FAST)

coverage:
	$(MAKE) test-all ARGS="--cov --cov-report=term $(ARGS)"

lint: install
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/python .ci/plain_code.py
	$(VENV)/bin/python .ci/large_files.py
	$(VENV)/bin/mypy

docs: install
	$(VENV)/bin/python -m congrasp.services.evaluate.results
	$(VENV)/bin/python -m sphinx -W --keep-going docs build/docs

# External inputs are options: make pictures ARGS="--scans object_sim --run runs/quickstart"
pictures: install
	PATH="$(abspath $(VENV))/bin:$$PATH" $(VENV)/bin/python -m tests.pictures $(ARGS)

bench:
	$(MAKE) install EXTRA=bench
	timeout 600 $(VENV)/bin/congrasp bench physics
	timeout 300 $(VENV)/bin/congrasp bench query
	timeout 300 $(VENV)/bin/python -m tests.benchmarks transport --seconds 3 --repeats 2 --versions 20
	timeout 600 $(VENV)/bin/python -m tests.benchmarks measures --repeats 3
	timeout 900 $(VENV)/bin/congrasp bench startup --preset quickstart --deadline 400

install: $(VENV)/.$(EXTRA)

$(VENV)/.$(EXTRA): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" && $(PYTHON) -c '$(supported)' 2>/dev/null || \
	  { echo "congrasp needs Python 3.11, 3.12 or 3.13. Install one and name it: make PYTHON=python3.12" >&2; exit 2; }
	@test -x $(VENV)/bin/python || { echo "Making $(VENV) with $(PYTHON)"; $(PYTHON) -m venv $(VENV); } || \
	  { echo "Python's venv module does not work here. On Debian or Ubuntu: apt-get install python3-venv" >&2; exit 2; }
	@echo "Installing congrasp[$(EXTRA)] into $(VENV): some minutes the first time (dev: about 3 GB)"
	$(PIP) install --quiet --upgrade --constraint $(CONSTRAINTS) pip
	@# setuptools warns of folders with the package's name: the only one is the package
	PYTHONWARNINGS='ignore:Editable installation' \
	  $(PIP) install --quiet --no-compile --constraint $(CONSTRAINTS) --editable '.[$(EXTRA)]'
	@# pip would compile on one core
	@$(VENV)/bin/python -m compileall -q -j 0 -x '/(tests?|OpenGL)/' $(VENV)/lib >/dev/null 2>&1 || true
	@touch $@

clean:
	rm -rf $(VENV) build *.egg-info .coverage* .mypy_cache .pytest_cache .ruff_cache .hypothesis
