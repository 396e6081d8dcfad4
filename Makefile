# Everything a stranger needs: `make quickstart` and `make test` set up their own environment.
.DEFAULT_GOAL := help
UV := python3 -m uv
RUN := $(UV) run --frozen --all-extras

.PHONY: help setup quickstart test test-fast lint

help:  ## this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 14

setup:  ## install the package with all extras into .venv (needs Python 3.12)
	@python3 -m uv --version >/dev/null 2>&1 || python3 -m pip install --quiet uv
	@$(UV) sync --frozen --all-extras

quickstart: setup  ## distil a teacher on FetchPickAndPlace, offline, in a few minutes
	@PATH="$(CURDIR)/.venv/bin:$$PATH" bash examples/quickstart.sh

test: setup  ## all tests, fast ones first
	@OMP_NUM_THREADS=1 $(RUN) pytest -m "not slow" -n auto --dist loadfile
	@OMP_NUM_THREADS=1 $(RUN) pytest -m slow -n auto --dist worksteal

test-fast: setup  ## tests without the end-to-end runs
	@OMP_NUM_THREADS=1 $(RUN) pytest -m "not slow" -n auto --dist loadfile

lint: setup  ## ruff and mypy
	@$(RUN) ruff check . && $(RUN) ruff format --check . && $(RUN) mypy
