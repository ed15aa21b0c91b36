# make demo and make test do all set-up themselves; make help lists the rest.

PYTHON ?= $(shell for p in python3.13 python3.12 python3.11 python3; do \
	$$p -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 && echo $$p && break; done)
VENV := .venv
BIN := $(VENV)/bin
PIP_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-input --constraint constraints.txt
RUN_STAMP := $(VENV)/.installed
DEV_STAMP := $(VENV)/.installed-dev
DEMO_ARGS ?=
COVERAGE_ARGS ?=
CONFUSION_ARGS ?=
SCAN_ARGS ?=
FUZZ_ARGS ?=
TRIED_ARGS ?=
CHALLENGE_ARGS ?=

.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: demo test studies check static format format-check lint types layers docs coverage confusion tried-gains design-scan fleet-kills fuzz trust challenge paper pictures bench examples clean help

demo: $(RUN_STAMP) ## the main job on the built-in virtual cart; writes servolens-demo/
	@$(BIN)/servolens demo $(DEMO_ARGS)

test: $(DEV_STAMP) ## the tests, in minutes
	@$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile -m "not slow"

studies: $(DEV_STAMP) ## the slow tests: more seeds, more worlds, all examples (long)
	@$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist worksteal -m slow

check: static test ## everything that must be green before a change lands

static: format-check lint types layers docs ## format check, lint, types, layers, docs

format: $(DEV_STAMP) ## rewrite the code in the house's format
	@$(BIN)/ruff format
	@$(BIN)/ruff check --fix --exit-zero --quiet

format-check: $(DEV_STAMP)
	@$(BIN)/ruff format --check

lint: $(DEV_STAMP) ## ruff
	@$(BIN)/ruff check

types: $(DEV_STAMP) ## mypy --strict
	@$(BIN)/mypy

layers: $(DEV_STAMP) ## imports go down only
	@$(BIN)/lint-imports --no-logo

docs: $(DEV_STAMP) ## the documentation, into site/, every link checked
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@$(BIN)/python docs/check_links.py
	@echo "docs: site/index.html"

coverage: $(DEV_STAMP) ## how often the 95 % intervals hold the truth, by model and by effect (minutes)
	@$(BIN)/python benchmarks/coverage.py
	@$(BIN)/python benchmarks/fit_coverage.py $(COVERAGE_ARGS)

confusion: $(DEV_STAMP) ## how often a diagnosis names what was hidden, and what else it names (hours)
	@$(BIN)/python benchmarks/confusion.py $(CONFUSION_ARGS)

tried-gains: $(DEV_STAMP) ## recommended gains on axes whose truth is hidden (hours for all 300)
	@$(BIN)/python benchmarks/tried_gains.py $(TRIED_ARGS)

design-scan: $(DEV_STAMP) ## designs of a thousand random plants against a dense scan of the gain (minutes)
	@$(BIN)/python benchmarks/design_scan.py $(SCAN_ARGS)

fuzz: $(DEV_STAMP) ## damaged and hostile files for every reader; what breaks one is kept in fuzz-findings/
	@$(BIN)/python benchmarks/fuzz.py $(FUZZ_ARGS)

fleet-kills: $(DEV_STAMP) ## a fleet whose processes are killed at 200 random moments (half an hour)
	@SERVOLENS_KILLS=200 $(BIN)/python -m pytest tests/test_fleet_faults.py -k random_moments

trust: $(DEV_STAMP) ## certified regressions and friction in closed form: digits, into docs/trust.md
	@$(BIN)/python benchmarks/trust.py

challenge: $(DEV_STAMP) ## servolens and two rivals name hidden effects, into docs/challenge.md (an hour)
	@$(PIP_INSTALL) --editable '.[benchmarks]'
	@$(BIN)/python benchmarks/challenge.py $(CHALLENGE_ARGS)

paper: $(DEV_STAMP) ## the paper's numbers computed again, into docs/paper.md
	@$(BIN)/python benchmarks/paper.py

pictures: $(DEV_STAMP) ## the pictures of the README and of the paper's page, made by the demo, and of the effects
	@$(BIN)/python docs/pictures.py
	@$(BIN)/python docs/effect_pictures.py

bench: $(DEV_STAMP) ## the figures of docs/speed.md, measured here
	@$(BIN)/python benchmarks/run.py

examples: $(DEV_STAMP) ## run every example
	@for script in examples/*.py; do echo "== $$script"; $(BIN)/python "$$script" || exit 1; done

clean: ## remove what the commands above made, but for .venv
	@rm -rf site build dist servolens-demo .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache .benchmarks
	@find . -path ./$(VENV) -prune -o -name __pycache__ -type d -prune -exec rm -rf {} +

help:
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-11s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "servolens needs Python 3.11 or newer with venv (Debian, Ubuntu: apt install python3-venv); none was found. Name yours: make PYTHON=/path/to/python3" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "servolens needs Python 3.11 or newer; $(PYTHON) is not" >&2; exit 1; }
	@$(PYTHON) -m venv --clear $(VENV) || { rm -rf $(VENV); exit 1; }

$(RUN_STAMP): pyproject.toml constraints.txt | $(BIN)/python
	@echo "Installing servolens into $(VENV) ..." >&2
	@$(PIP_INSTALL) --editable .
	@touch $@

$(DEV_STAMP): pyproject.toml constraints.txt | $(BIN)/python
	@echo "Installing servolens and its development tools into $(VENV) ..." >&2
	@$(PIP_INSTALL) --editable '.[dev,docs,formats]'
	@touch $@ $(RUN_STAMP)
