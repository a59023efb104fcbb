# Two commands for a newcomer: `make demo` and `make test`.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin

.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help demo quick test nightly versions docs dist format env-dev system-packages cards tables sample-data clean

help: ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-12s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

demo: ## Render six views of the lattice, predict with four methods, score, and write the reports
	@scripts/system_packages.sh blender
	@scripts/environment.sh $(PYTHON) $(VENV)-demo build
	$(VENV)-demo/bin/rebar-bench demo

quick: env-dev ## Format, lint, types, import contracts, and the fast tests that need no Blender, server, database or browser
	scripts/check.sh $(BIN) quick

test: system-packages env-dev ## Quick, and real renders, servers, databases and browser: all tests but the nightly ones
	scripts/check.sh $(BIN) test

nightly: system-packages env-dev ## Everything, with the long stress tests and 10,000 damaged inputs
	scripts/check.sh $(BIN) nightly
	$(BIN)/python -m tests.fuzz --cases 10000 --log fuzz.jsonl
	$(BIN)/python -m tests.fuzz.damaged_meshes

versions: ## The fast tests of the core on other versions of Python: all that are found, or VERSIONS="3.12 3.13"
	scripts/versions.sh $(VERSIONS)

dist: env-dev ## Build and check the source distribution and the wheel in dist/
	rm -rf dist
	$(BIN)/python -m build --outdir dist
	$(BIN)/python -m twine check --strict dist/*

format: env-dev ## Format the code and apply the linter's safe fixes
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

cards: env-dev ## Write the benchmark card, measures, results and the table of the README
	$(BIN)/python -m cards

tables: env-dev ## Write the tables of the documentation that list what the code declares
	$(BIN)/python -m scripts.tables

docs: system-packages env-dev ## Build the documentation as a site in build/docs; a warning is an error
	$(BIN)/python -m sphinx -W --keep-going -n -q docs build/docs

sample-data: system-packages env-dev ## Render the sample of the package and the data of the tests again, after a change of the format
	$(BIN)/python -m tests.data.render

env-dev: ## Make .venv for developing and testing
	@scripts/environment.sh $(PYTHON) $(VENV) dev

system-packages: ## Check the system packages that rendering and testing need; as root on Debian, install them
	@scripts/system_packages.sh blender browser uploads proxy

clean: ## Remove the environments and the demo's output
	rm -rf $(VENV) $(VENV)-3.* $(VENV)-demo build dist *.egg-info demo-output
