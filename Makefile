# Two commands for a newcomer: `make demo` and `make test`.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin

.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help demo quick test nightly check format env env-dev env-space system-packages cards docs sample-data clean

help: ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-12s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

demo: ## Render a small lattice set, predict, score, and write the report
	@scripts/system_packages.sh blender
	@scripts/environment.sh $(PYTHON) $(VENV) build
	$(BIN)/rebar-bench demo

quick: env-dev ## Format, lint, types, import contracts, and the fast tests that need no Blender, server, database or browser
	scripts/check.sh $(BIN) quick

test: system-packages env-dev ## Everything that CI runs: quick, and real renders, servers, databases and browser
	scripts/check.sh $(BIN) test

nightly: system-packages env-dev env-space ## Everything, with the long stress tests and 10,000 damaged inputs
	scripts/check.sh $(BIN) nightly
	$(BIN)/python -m tests.fuzz --cases 10000 --log fuzz.jsonl

format: env-dev ## Format the code and apply the linter's safe fixes
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

cards: env-dev ## Write the benchmark card from the code
	$(BIN)/python -m cards > cards/BENCHMARK.md

docs: env-dev ## Build the documentation as a site in build/docs, and fail on any warning
	$(BIN)/python -m sphinx -W --keep-going -n -q -b html docs build/docs

sample-data: system-packages env-dev ## Render the dataset in tests/data again, after a change of the format
	$(BIN)/python -m tests.data.render

env-dev: ## Make .venv for developing and testing
	@scripts/environment.sh $(PYTHON) $(VENV) dev

env-space: ## Make .venv-space for the Gradio app in examples/space, which is tested only where it exists
	@scripts/environment.sh $(PYTHON) $(VENV)-space space

system-packages: ## Check the system packages that rendering and testing need; as root on Debian, install them
	@scripts/system_packages.sh blender browser uploads

clean: ## Remove the environments and the demo's output
	rm -rf $(VENV) $(VENV)-space demo-output
