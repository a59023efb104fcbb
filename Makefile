# Two commands for a newcomer: `make demo` and `make test`.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin

.DEFAULT_GOAL := help
.PHONY: help demo test check format env env-dev cards clean

help: ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-8s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

demo: env ## Render a small lattice set, predict, score, and write the report
	$(BIN)/rebar-bench demo

test: env-dev ## Run everything CI runs: format, lint, types, import rules, tests
	scripts/check.sh $(BIN)

format: env-dev ## Format the code and sort out what the linter can
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

cards: env-dev ## Write the benchmark card from the code
	$(BIN)/python -m cards > cards/BENCHMARK.md

env: ## Make .venv for building, predicting and scoring
	@scripts/environment.sh $(PYTHON) $(VENV) build

env-dev: ## Make .venv for developing and testing
	@scripts/environment.sh $(PYTHON) $(VENV) dev

clean: ## Remove the environment and the demo's output
	rm -rf $(VENV) demo-output
