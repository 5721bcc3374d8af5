# Two commands: `make demo` and `make test`. Stamp files keep a half-made environment from passing
# for a whole one: a failed `python -m venv` leaves a folder behind.

PYTHON ?= $(firstword $(foreach v,3.11 3.12 3.13 3,$(if $(shell python$(v) -c "import sys, venv, ensurepip; assert (3, 11) <= sys.version_info[:2] <= (3, 13)" 2>/dev/null && echo yes),python$(v))))
VENV := .venv
BIN := $(VENV)/bin
PIP_INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check --only-binary :all: -c constraints.txt
OUT ?= runs/demo

# One thread for each BLAS call and numba's own pool for the rest, so that two pools do not fight for the cores.
export OPENBLAS_NUM_THREADS ?= 2

.PHONY: demo test slow bench clean

demo: $(VENV)/.core
	$(BIN)/bathynav demo --out $(OUT)

test: $(VENV)/.dev
	$(BIN)/lint-imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -n 2 -m "not slow"

slow: $(VENV)/.dev
	$(BIN)/python -m pytest -m slow

bench: $(VENV)/.bench
	$(BIN)/bathynav benchmark

clean:
	rm -rf $(VENV)

$(VENV)/.made:
	@test -n "$(PYTHON)" || { echo "bathynav needs Python 3.11, 3.12 or 3.13 with venv: install python3 and python3-venv, or name one: make PYTHON=/path/to/python3.11"; exit 1; }
	rm -rf $(VENV)
	$(PYTHON) -m venv $(VENV)
	touch $@

$(VENV)/.core: $(VENV)/.made pyproject.toml constraints.txt
	@echo "installing the pinned dependencies into $(VENV) (about a minute)"
	$(PIP_INSTALL) -e .
	touch $@

$(VENV)/.dev: $(VENV)/.core
	$(PIP_INSTALL) -e ".[dev]"
	touch $@

$(VENV)/.bench: $(VENV)/.dev
	$(PIP_INSTALL) -e ".[bench]"
	touch $@
