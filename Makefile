# Every target makes its own environment in .venv first; nothing is installed outside this folder.
#
#   make study                      the studies and their report, out/report
#   make test PYTHON=python3.12     another interpreter (>= 3.11)

.DEFAULT_GOAL := help
.PHONY: help study study-full test test-all lint bench docs clean distclean
.DELETE_ON_ERROR:

# The interpreter that .venv was made with stays in use until another one is asked for.
PYTHON ?= $(if $(wildcard .venv/bin/python),.venv/bin/python,python3)
SEED ?= 1
OUT ?= out/report

unexport PYTHONPATH PYTHONHOME
export PIP_CONSTRAINT := constraints.txt
export PIP_BUILD_CONSTRAINT := constraints.txt
export PIP_DISABLE_PIP_VERSION_CHECK := 1
export PIP_NO_INPUT := 1

# Empty when the interpreter is missing or too old; part of the stamp's name, so that another version installs anew.
VERSION := $(shell "$(PYTHON)" -c "import sys; print('%d.%d.%d' % sys.version_info[:3] if sys.version_info >= (3, 11) else '')" 2>/dev/null)
RUN := .venv/.installed-$(VERSION)
DEV := .venv/.installed-dev-$(VERSION)
RUN_PYTHON := .venv/bin/python

define environment
@test -n "$(VERSION)" || { \
  echo "This project needs Python 3.11 or newer; '$(PYTHON)' is $$(command -v "$(PYTHON)" >/dev/null && "$(PYTHON)" --version 2>&1 || echo 'not there')." >&2; \
  echo "Name another interpreter, for example: make $(MAKECMDGOALS) PYTHON=python3.12" >&2; exit 1; }
@echo "Setting up .venv for Python $(VERSION) (a minute or two) ..."
@test "$$($(RUN_PYTHON) -c "import sys, pip; print('%d.%d.%d' % sys.version_info[:3])" 2>/dev/null)" = "$(VERSION)" \
  || "$(PYTHON)" -m venv --clear .venv
endef

help:  ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-11s %s\n", $$1, $$2}' Makefile
	@echo "  options: PYTHON=python3.12 (interpreter), OUT=$(OUT) (report), SEED=$(SEED) (order of the tests)"

$(RUN): pyproject.toml constraints.txt
	$(environment)
	$(RUN_PYTHON) -m pip install --quiet -c constraints.txt -e .
	@touch "$@"

$(DEV): pyproject.toml constraints.txt
	$(environment)
	$(RUN_PYTHON) -m pip install --quiet -c constraints.txt -e ".[dev]"
	@touch "$(RUN)" "$@"

study: $(RUN)  ## all studies, report in out/report
	.venv/bin/reentry study --out "$(OUT)"

study-full: $(RUN)  ## all studies with the large ensembles
	.venv/bin/reentry study --full --out "$(OUT)"

test: $(DEV)  ## the tests, without the slow ones
	$(RUN_PYTHON) -m pytest -m "not slow" --randomly-seed=$(SEED)

test-all: $(DEV)  ## all tests
	$(RUN_PYTHON) -m pytest --randomly-seed=$(SEED)

lint: $(DEV)  ## style, types, import rules, rules of this repository
	$(RUN_PYTHON) -m ruff check
	$(RUN_PYTHON) -m ruff format --check
	$(RUN_PYTHON) -m mypy
	.venv/bin/lint-imports
	$(RUN_PYTHON) -m pytest -q tests/test_repository.py

bench: $(DEV)  ## all benchmarks
	@set -e; for file in benchmarks/[a-z]*.py; do \
	  name=$$(basename "$$file" .py); echo "== $$name"; $(RUN_PYTHON) -m "benchmarks.$$name"; done

docs: $(DEV)  ## the documentation, docs/_build/html (warnings are errors)
	$(RUN_PYTHON) -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo "docs/_build/html/index.html"

clean:  ## remove what was computed
	rm -rf out dist docs/_build .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis .jupyter_cache
	rm -f docs/tutorials/*.ipynb
	find . -path ./.venv -prune -o -name __pycache__ -type d -exec rm -rf {} +

distclean: clean  ## remove also the environment (after moving the folder, for example)
	rm -rf .venv
