PYTHON ?= python3
JOBS ?= 2
PYTEST_ARGS ?=
# A file's tests share compiled programs; files start in the order of tests/costs.json, not of their numbers of tests.
BY_FILE := --dist loadfile --no-loadscope-reorder

BIN := .venv/bin
# Named after the place too, because an environment is bound to it: a copied checkout has to make its own.
READY := .venv/.ready-$(shell printf %s '$(CURDIR)' | cksum | cut -d ' ' -f 1)

# Packages of another Python (a sourced ROS set-up, say) would be found before the locked ones.
unexport PYTHONPATH
unexport PYTHONHOME

.DEFAULT_GOAL := help
.PHONY: help env demo test test-slow test-all samples costs lint types docs pictures notebooks format bench attack firmware package lock clean distclean

help: ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' Makefile

$(READY): requirements.lock pyproject.toml hardware/pyproject.toml tools/bootstrap.py
	@$(PYTHON) tools/bootstrap.py
	@touch $@

demo: $(READY) ## simulate, learn, and predict a held-out recording; results in demo/
	$(BIN)/python examples/demo.py --out demo/

pictures: $(READY) ## run all the examples and the gallery, and draw their pictures for the documentation
	$(BIN)/python -m tools.pictures
	$(BIN)/python -m tools.gallery

notebooks: $(READY) ## run the notebooks' texts, and write docs/notebooks/*.ipynb
	$(BIN)/python -m tools.notebooks

env: $(READY) ## make the environment

test: $(READY) ## run the tests, but for the slow and the long ones (some 7 min on two cores)
	$(BIN)/python -m pytest -n $(JOBS) $(BY_FILE) -m "not slow and not campaign" $(PYTEST_ARGS)

test-slow: $(READY) ## run the tests of more than some seconds each, as CI does after `make test` (some 12 min)
	$(BIN)/python -m pytest -n $(JOBS) $(BY_FILE) -m "slow and not campaign" $(PYTEST_ARGS)

test-all: $(READY) ## run all the tests, the long ones too
	$(BIN)/python -m pytest -n $(JOBS) $(BY_FILE) $(PYTEST_ARGS)

samples: $(READY) ## run a few of the long tests of docs, examples, recordings and types (`make test-all` runs all)
	$(BIN)/python -m pytest -n $(JOBS) --dist load --quick -m sample $(PYTEST_ARGS)

costs: $(READY) ## measure the CPU time of each test file anew, for the order and the time left of `make test`
	KNODE_COSSERAT_CACHE=build/cold-cache-$(shell date +%s) $(BIN)/python -m pytest -n $(JOBS) $(BY_FILE) -m "not campaign" --write-costs

lint: $(READY) ## check style, formatting and the sizes of the code
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/python -m tools.budget

types: $(READY) ## check the types
	$(BIN)/mypy

docs: $(READY) ## build the documentation as a site in build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --clean

format: $(READY) ## format the code, and fix what can be fixed without a decision
	$(BIN)/ruff check --fix-only
	$(BIN)/ruff format

bench: $(READY) ## run the benchmarks
	$(BIN)/python -m benchmarks.run

firmware: ## build the firmware of the tension board, and its emulator (needs Debian's arduino-core-avr; see firmware/README.md)
	@$(MAKE) --no-print-directory -C firmware OUT=$(CURDIR)/build/firmware

attack: $(READY) ## damaged files, kills, disk faults, extreme robots, a flood of the live server (an hour; see tools/attack)
	$(BIN)/python -m tools.attack

package: $(READY) ## build wheels and sdists into dist/, and use the wheels in an environment of their own
	$(BIN)/python tools/check_package.py

lock: ## write requirements.lock anew from both pyproject.toml (UPGRADE=1: with the newest versions)
	$(PYTHON) tools/bootstrap.py lock $(if $(UPGRADE),--upgrade)

clean: ## remove outputs and caches
	rm -rf demo build dist hardware/dist .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find src hardware studies tests examples benchmarks tools -name __pycache__ -type d -prune -exec rm -rf {} + 2>/dev/null || true

distclean: clean ## remove the virtual environment too
	rm -rf .venv
