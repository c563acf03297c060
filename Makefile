# Everything that koop needs lands in .venv and out/; nothing else on the machine changes.
PYTHON ?= python3
PYTEST_ARGS ?=

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
# One stamp for each set of extras: a second run installs nothing, a changed pin installs again.
RUN_STAMP := $(VENV)/.installed-run
TEST_STAMP := $(VENV)/.installed-test
PINS := build/pins

# The pyright wheel carries its own checker: keep it from looking for a newer one.
export PYRIGHT_PYTHON_IGNORE_WARNINGS := 1
export PYTHONUNBUFFERED := 1

.DEFAULT_GOAL := help
.PHONY: help demo test bench postgres pins clean distclean

help: ## List the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

demo: $(RUN_STAMP) ## Stream, predict and control a simulated cartpole; leaves out/demo.png
	@mkdir -p out
	$(BIN)/python -m koop_clients.demo

test: $(TEST_STAMP) postgres ## Lint, types, import contracts and tests
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .
	$(BIN)/python -m pyright
	$(BIN)/lint-imports
	$(BIN)/python -m pytest $(PYTEST_ARGS)

bench: $(TEST_STAMP) ## Print the benchmark tables
	$(BIN)/python benchmarks/update.py
	$(BIN)/python benchmarks/accuracy.py
	$(BIN)/python benchmarks/control.py
	$(BIN)/python benchmarks/commands.py
	$(BIN)/python benchmarks/service.py
	$(BIN)/python benchmarks/flood.py
	$(BIN)/python benchmarks/soak.py
	$(BIN)/python benchmarks/fuzz.py --plain --seconds 10
	$(BIN)/python benchmarks/training.py
	$(BIN)/python benchmarks/mixed.py
	$(BIN)/python benchmarks/flow.py
	$(BIN)/python benchmarks/durability.py --rounds 1 --seconds 5 --kills 3
	$(BIN)/python benchmarks/failover.py
	$(BIN)/python benchmarks/workers.py
	$(BIN)/python benchmarks/flow_physics.py --quick

pins: ## Write constraints.txt anew from the newest versions that pyproject.toml allows
	rm -rf $(PINS)
	$(PYTHON) -m venv $(PINS)
	$(PINS)/bin/python -m pip install '.[service,sim,deploy,train,cluster,dev,fuzz]'
	@# A local suffix (+cpu) names one machine's build, and CUDA's packages follow from torch's own pin.
	( grep '^#' constraints.txt; \
	  $(PINS)/bin/python -m pip freeze --all --exclude pip --exclude koop \
	    | sed 's/+[A-Za-z0-9.]*$$//' | grep -v -E '^(nvidia|cuda|triton)' | LC_ALL=C sort -f ) > build/constraints.txt
	mv build/constraints.txt constraints.txt
	rm -rf $(PINS)

clean: ## Remove what was made, but keep .venv
	rm -rf out build dist .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find protocol service clients tests benchmarks -type d -name __pycache__ -prune -exec rm -rf {} +

distclean: clean ## Remove .venv too
	rm -rf $(VENV)

# The tests start a server of their own, so that nothing but its programs is needed.
postgres:
	@command -v initdb >/dev/null || ls /usr/lib/postgresql/*/bin/initdb >/dev/null 2>&1 || { \
	  if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	    apt-get update -q && apt-get install -y -q --no-install-recommends postgresql; \
	  else \
	    echo "The tests need PostgreSQL's server programs, initdb and postgres. Install them, for" \
	      "example: sudo apt-get install postgresql" >&2; \
	    exit 1; \
	  fi; }

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "koop needs Python 3.11 or newer, but '$(PYTHON)' is: $$($(PYTHON) --version 2>&1 | tail -n 1)."; \
	  echo "Name another one, for example: make $(firstword $(MAKECMDGOALS)) PYTHON=python3.12"; \
	  exit 1; } >&2
	@# Without pip inside, a half-made environment would look finished to the next run.
	$(PYTHON) -m venv --clear $(VENV) || { rm -rf $(VENV); exit 1; }

$(RUN_STAMP): pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) install -c constraints.txt -e '.[service,sim,deploy]'
	@touch $@

$(TEST_STAMP): pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) install -c constraints.txt -e '.[service,sim,deploy,train,cluster,dev]'
	@touch $(RUN_STAMP) $@
