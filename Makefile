# Everything from a fresh clone with python >= 3.11, git and make: the environment is .venv/, made when needed.

PYTHON ?= $(shell for p in python3 python3.14 python3.13 python3.12 python3.11 python; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
BIN := .venv/bin
PIP := $(BIN)/python -m pip --quiet --quiet --disable-pip-version-check

export OMP_NUM_THREADS ?= 1
# What is compiled is kept: the tests start hundreds of commands.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help demo test test-fast test-lowest lint format docs site results-report bench clean

help:
	@echo "make demo    identify a pushed box from the bundled Go1 log, print the table, write the report"
	@echo "make test    run the whole test suite"
	@echo "make test-fast"
	@echo "             run what takes less than a second each, for every change"
	@echo "make test-lowest"
	@echo "             run the fast tests with the lowest versions that pyproject.toml allows (Python 3.11)"
	@echo "make lint    ruff and pyright"
	@echo "make format  let ruff format the code"
	@echo "make docs    write docs/cli.md from the commands' own help"
	@echo "make site    the documentation as a site with search, in site/"
	@echo "make results-report"
	@echo "             tables and figures of docs/results/, in docs/results.md"
	@echo "make bench   run the benchmarks"
	@echo "make clean   remove the environments and all caches"

demo: .venv/.installed
	$(BIN)/amhe identify examples/logs/t1.mcap -o amhe-out/demo --force

# worksteal: each worker begins with files that stand together, so that what they share is made once.
# Tests of emulated robots come last, one after another: beside others that compute, a machine is late.
# A test by the wall clock that fails is run again, as a machine that others use may stand still for half a second; the summary lists it.
test: .venv/.installed-dev
	$(BIN)/python -m pytest -q -n auto --dist worksteal -m "not realtime"; others=$$?; \
	$(BIN)/python -m pytest -q -m realtime --reruns 2 $$(grep -rl --include="*.py" mark.realtime tests) && exit $$others

test-fast: .venv/.installed-dev
	$(BIN)/python -m pytest -q -n auto --dist worksteal -m "not slow and not medium"

test-lowest: .venv-lowest/.installed
	.venv-lowest/bin/python -m pytest -q -n auto --dist worksteal -m "not slow"

lint: .venv/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

format: .venv/.installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: .venv/.installed-dev
	$(BIN)/python docs/make_cli_docs.py

site: .venv/.installed-dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

results-report: .venv/.installed
	$(BIN)/python docs/make_results.py

bench: .venv/.installed-bench
	@for table in $(filter-out benchmarks/common.py benchmarks/plants.py,$(wildcard benchmarks/*.py)); do echo "== $$table"; $(BIN)/python $$table || exit 1; done

clean:
	rm -rf .venv .venv-lowest amhe-out build dist .pytest_cache .ruff_cache .hypothesis *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "amhe needs Python >= 3.11; set PYTHON=/path/to/python3" >&2; exit 1; }
	@echo "Setting up .venv (once; a minute or two) ..."
	@$(PYTHON) -m venv .venv

.venv/.installed: pyproject.toml | $(BIN)/python
	@$(PIP) install --editable .
	@touch $@

.venv/.installed-dev: pyproject.toml | $(BIN)/python
	@# compiled by all cores, where pip takes one
	@$(PIP) install --no-compile --editable '.[dev]'
	@$(BIN)/python -m compileall -qq -j 0 .venv/lib || true
	@# the maker's own library, to test against: not for every Python, and what it says it needs, it does not
	@$(PIP) install --no-deps --only-binary :all: unitree-legged-sdk==3.8.20231105 2>/dev/null || true
	@touch .venv/.installed $@

# wheels only: versions so old that they must be built are none that anybody installs
.venv-lowest/.installed: pyproject.toml | $(BIN)/python
	@$(PIP) install uv
	@$(BIN)/uv venv --quiet --clear --seed --python 3.11 .venv-lowest
	@$(BIN)/uv pip install --quiet --python .venv-lowest --resolution lowest-direct \
		--only-binary :all: --no-binary amhe --editable '.[dev]'
	@touch $@

.venv/.installed-bench: pyproject.toml | $(BIN)/python
	@$(PIP) install --editable '.[bench]'
	@touch .venv/.installed $@
