# `make demo` and `make test` need python3 (3.11 or newer) and make; everything else they set up, once, in .venv.

PYTHON ?= python3
VENV ?= .venv
WORKERS ?= 2
DEMO ?= demo
DEMO_SECONDS ?= 60
ARGS ?=
FUZZ ?=
SOAK ?= soak
KILLS ?= 60
STEPS ?= 600000

RUN := $(VENV)/bin/python
READY := $(VENV)/.stamp-ready
DOCS_READY := $(VENV)/.stamp-docs

.PHONY: help demo test fuzz lint format types docs soak audit clean

help:
	@echo 'make demo     simulate a drive, run the odometry, smooth, evaluate, report   (DEMO_SECONDS=60 DEMO=demo)'
	@echo 'make test     all tests   (WORKERS=2 ARGS="-k kalman")'
	@echo 'make fuzz     damage the inputs of every reader   (FUZZ="--count 200 --seconds 60 --seed -1"; GUIDED=600: Atheris too, 600 s each)'
	@echo 'make lint     ruff: rules and format        make format   apply both'
	@echo 'make types    mypy, strict, on all packages and benchmarks'
	@echo 'make docs     build the documentation into site/, strictly'
	@echo 'make soak     kill seven commands at random moments and compare their results, and use graphs at random   (KILLS=60 STEPS=600000 SOAK=soak)'
	@echo 'make audit    known vulnerabilities and licences of the dependencies'
	@echo 'make clean    remove the environment and everything that was built'

demo: $(READY)
	@HYBRIDLIO='$(RUN) -m hybridlio' bash scripts/demo.sh '$(DEMO)' '$(DEMO_SECONDS)'

test: $(READY)
	$(RUN) -m pytest -n $(WORKERS) --dist loadfile $(ARGS)

fuzz: $(READY)
	$(RUN) tests/fuzz_readers.py $(FUZZ)
ifdef GUIDED
	@$(RUN) -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[fuzz]'
	$(RUN) tests/fuzz_guided.py --seconds $(GUIDED)
endif

lint: $(READY)
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .

format: $(READY)
	$(RUN) -m ruff check --fix .
	$(RUN) -m ruff format .

types: $(READY)
	$(RUN) -m mypy
	$(RUN) -m mypy benchmarks

docs: $(DOCS_READY)
	NO_MKDOCS_2_WARNING=1 $(RUN) -m mkdocs build --strict --quiet

soak: $(READY)
	$(RUN) benchmarks/kills.py '$(SOAK)' --kills $(KILLS)
	$(RUN) tests/fuzz_graph.py --steps $(STEPS)

audit: $(READY)
	@$(RUN) -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[audit]'
	$(RUN) scripts/licences.py
	$(RUN) scripts/vulnerabilities.py

clean:
	rm -rf $(VENV) build dist site *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .coverage

$(RUN):
	@$(PYTHON) -c 'import sys; sys.exit("hybridlio needs Python 3.11 or newer: make PYTHON=python3.11" if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)

$(READY): pyproject.toml constraints.txt scripts/system-libraries.sh | $(RUN)
	@bash scripts/system-libraries.sh $(RUN)
	@echo 'installing hybridlio and what it needs into $(VENV) (a few minutes, once)'
	@$(RUN) -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[test]'
	@$(RUN) -m pip install -qq --disable-pip-version-check -c constraints.txt --no-deps ouster-sdk more-itertools
	@touch $@

$(DOCS_READY): $(READY)
	@$(RUN) -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[docs]'
	@touch $@
