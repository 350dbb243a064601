# Tasks of the project. "make help" lists them. Every task sets up .venv first.
PYTHON := .venv/bin/python
export OMP_WAIT_POLICY ?= passive

.PHONY: help setup format check quick test slow coverage demo bench pages docs

help: ## list the tasks
	@grep -E '^[a-z]+:.*##' Makefile | sed 's/:.*## /\t/' | expand -t 12

setup: ## create or update .venv
	@bash scripts/setup.sh

format: setup ## format the code
	$(PYTHON) -m ruff format .
	$(PYTHON) -m ruff check --fix .

check: setup ## format, lint and type checks, without tests
	$(PYTHON) -m ruff format --check .
	$(PYTHON) -m ruff check .
	$(PYTHON) -m mypy

quick: setup ## tests that a change of the algorithms needs (about 2 minutes on two cores)
	OMP_NUM_THREADS=1 $(PYTHON) -m pytest tests --quick -n auto --dist loadfile --no-loadscope-reorder

test: ## all checks and tests (7 to 10 minutes on two cores)
	bash scripts/test.sh

slow: ## all checks and tests, the long ones included
	bash scripts/test.sh --slow

coverage: setup ## tests with branch coverage of the package
	$(PYTHON) -m pytest --cov=rsvib_torch --cov-branch --cov-report=term:skip-covered --cov-report=xml:out/coverage.xml

demo: ## simulate, detect and restore two scenes into out/demo
	bash scripts/demo.sh

bench: setup ## run the benchmarks and store their results
	$(PYTHON) scripts/benchmark.py --store

pages: setup ## write the generated pages and drawings of docs/ anew
	$(PYTHON) scripts/reference_pages.py
	$(PYTHON) scripts/benchmark.py --pages
	$(PYTHON) scripts/figures.py --drawings --out docs
	$(PYTHON) scripts/run_pages.py

docs: setup ## build the documentation into out/site; warnings are errors
	$(PYTHON) scripts/docs.py
