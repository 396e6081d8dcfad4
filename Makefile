# Everything a stranger needs: `make quickstart` and `make test` set up their own environment.
.DEFAULT_GOAL := help
# uv as it is installed, or in a folder of its own: many systems let nobody install into their Python (PEP 668).
UV := $(shell uv --version >/dev/null 2>&1 && echo uv || echo .uv/bin/uv)
RUN := $(UV) run --frozen --all-extras

.PHONY: help setup quickstart bench test test-fast lint docs .mypy

help:  ## this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 14

.uv/bin/uv:
	@python3 -m venv .uv && .uv/bin/python -m pip install --quiet uv

# Compiled here once: where PYTHONDONTWRITEBYTECODE is set, every process would compile LeRobot and torch anew.
setup: $(filter .uv/bin/uv,$(UV))  ## install the package with all extras into .venv (needs Python 3.12)
	@$(UV) sync --frozen --all-extras --compile-bytecode

quickstart: setup  ## distill a teacher that lifts any of three cubes, offline, and watch it
	@PATH="$(CURDIR)/.venv/bin:$$PATH" bash examples/quickstart.sh

bench: setup  ## how fast it is, against LeRobot and against the floors, in a quarter of an hour
	@MUJOCO_GL=$${MUJOCO_GL:-egl} HF_HUB_OFFLINE=1 OMP_NUM_THREADS=1 $(RUN) python benchmarks/speed/bench.py
	@$(RUN) python benchmarks/render.py

test: setup  ## all tests, fast ones first
	@OMP_NUM_THREADS=1 $(RUN) pytest -m "not slow" -n auto --dist loadfile
	@OMP_NUM_THREADS=1 $(RUN) pytest -m slow -n auto --dist worksteal

test-fast: setup  ## tests without the end-to-end runs
	@OMP_NUM_THREADS=1 $(RUN) pytest -m "not slow" -n auto --dist loadfile

lint: setup .mypy  ## ruff and mypy
	@$(RUN) ruff check . && $(RUN) ruff format --check . && $(RUN) mypy

docs: setup  ## the documentation's site, strictly, into site/
	@NO_MKDOCS_2_WARNING=1 $(RUN) --group docs mkdocs build --strict --quiet

.mypy: setup  # LeRobot's sources, which mypy does not follow in site-packages: they have no py.typed marker
	@mkdir -p .mypy && ln -sfn $$($(RUN) python -c 'import importlib.util as u; print(u.find_spec("lerobot").submodule_search_locations[0])') .mypy/lerobot
