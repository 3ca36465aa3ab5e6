# make demo      plan a bundled problem; creates the core environment in .venv when there is none
# make weights   makes training data and trains the weights anew, in runs/panda; the same command resumes
# make baselines trains the learned baselines on the same data, in runs/panda
# make install   the development environment with all extras in .venv
# make test      the quick tests: about five minutes on two idle cores; the first run compiles too, for about as long
# make test-all  all tests, those marked slow, browser, sim and cluster too
# make lint      ruff and pyright
# make bench     all benchmarks
# make docs      the documentation in site/; any warning is an error
# make gallery   the pictures of the gallery anew, by the examples

PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: install demo test test-all lint docs gallery bench weights baselines chromium compiled clean

.venv/bin/python:
	$(PYTHON) -m venv .venv

# uv takes a fraction of pip's time; where it cannot install, as from a mirror that only pip knows, pip does. PyTorch is left to
# pip: many machines configure for it where PyTorch without CUDA comes from.
PIP := $(BIN)/python -m pip install -q -c constraints.txt
UV := $(BIN)/uv pip install -q --python $(BIN)/python -c constraints.txt

.venv/core.stamp: pyproject.toml constraints.txt | .venv/bin/python
	$(PIP) uv && $(UV) -e . || { echo "uv could not install; now pip"; $(PIP) -e .; }
	touch $@

# the tests start hundreds of processes, each of which would compile what it imports
.venv/dev.stamp: pyproject.toml constraints.txt | .venv/bin/python
	$(PIP) uv torch && $(UV) --compile-bytecode -e ".[dev]" || { echo "uv could not install; now pip"; $(PIP) -e ".[dev]"; }
	touch .venv/core.stamp $@

install: .venv/dev.stamp

demo: .venv/core.stamp
	$(BIN)/robotdiffuse demo

# The live page and the search of the docs are tested in a browser. Root on Debian installs it where there is a
# network; without it these tests are skipped.
chromium:
	@command -v chromium >/dev/null || { test "$$(id -u)" = 0 && command -v apt-get >/dev/null && \
		{ timeout 120 apt-get update -qq; DEBIAN_FRONTEND=noninteractive \
		timeout 600 apt-get install -qq -y --no-install-recommends chromium; } >/dev/null 2>&1; } || \
		echo "there is no chromium: the tests in a browser are skipped"

test: .venv/dev.stamp
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow"

# on a new machine, before the tests: each process of the tests would compile for itself what all of them call
compiled: .venv/dev.stamp
	set -e; work=$$(mktemp -d); here=$$PWD; cd $$work; $$here/$(BIN)/robotdiffuse demo >/dev/null; \
		$$here/$(BIN)/robotdiffuse plan $$here/examples/upright_cup.yaml --planner aorrtc >/dev/null; rm -r $$work

test-all: .venv/dev.stamp chromium compiled
	$(BIN)/python -m pytest -n 2 --dist worksteal

# alone, one thread takes three quarters of the work of two, so .ci/run, which tests meanwhile, uses one
THREADS := --threads 2
lint: .venv/dev.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright $(THREADS) --pythonpath $(BIN)/python

# the variable silences an advertisement of the theme's authors
docs: .venv/dev.stamp
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

gallery: .venv/dev.stamp
	set -e; work=$$(mktemp -d); here=$$PWD; cd $$work; \
		for file in $$here/examples/[0-9]*.py; do $$here/$(BIN)/python "$$file"; done; \
		mkdir -p $$here/docs/images/gallery; cp ./*.png $$here/docs/images/gallery; rm -r $$work

BENCHMARKS := $(filter-out %/common.py,$(wildcard benchmarks/*.py))

bench: .venv/dev.stamp
	set -e; for file in $(BENCHMARKS); do echo "== $$file"; $(BIN)/python "$$file"; done

weights: .venv/dev.stamp
	$(BIN)/robotdiffuse data generate --out runs/panda/data --trajectories 31000 --seed 7 \
		--mix rop=0.4,rop_dense=0.3,shelf=0.1,crate=0.1,table=0.1 --trivial-share 0.1 --target pose --goals 1
	$(BIN)/robotdiffuse train encoder --out runs/panda/encoder --samples 160000
	$(BIN)/robotdiffuse train planner --out runs/panda/planner --config compact \
		--data runs/panda/data --encoder runs/panda/encoder

# as much of one core's time as the network that ships had, or less
baselines: .venv/dev.stamp
	$(BIN)/robotdiffuse train baseline mpnet --out runs/panda/mpnet --data runs/panda/data --samples 8000000
	$(BIN)/robotdiffuse train baseline mpinets --out runs/panda/mpinets --data runs/panda/data --samples 900000
	$(BIN)/robotdiffuse train baseline trajectory_prior --out runs/panda/prior --data runs/panda/data \
		--samples 1800000

clean:
	rm -rf .venv build dist site .pytest_cache .ruff_cache .hypothesis demo.png demo.html
