# Needs make and Python 3.11 to 3.13; everything else goes into .venv.
PYTHON ?= python3
EXTRAS ?= dev
ARGS ?=
TEST_ARGS ?=

comma := ,
STAMP := .venv/.installed-$(subst $(comma),-,$(EXTRAS))
BIN := .venv/bin

.PHONY: help setup train test test-slow test-all check docs bench soak profile lock release clean
.DELETE_ON_ERROR:

help:
	@echo "make train ARGS='experiment=constant70 game=breakout'   train one agent"
	@echo "make test | test-slow | test-all  fast tests | the others | both"
	@echo "make check | docs                 style and types | the site, in build/site"
	@echo "make bench | profile | soak       measure the parts | trace a short run | train for half an hour and watch"
	@echo "make setup EXTRAS=dev,cuda        (re)install, here for an NVIDIA GPU"
	@echo "make lock | release | clean       renew requirements.lock | wheel, sdist, SBOM in dist | remove what was installed"

setup: $(STAMP)

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' 2>/dev/null || \
	  { echo "foajax: error: PYTHON=$(PYTHON): accepted is Python 3.11, 3.12 or 3.13"; exit 2; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
	  { echo "foajax: error: PYTHON=$(PYTHON): its venv module is missing (on Debian: apt-get install python3-venv)"; exit 2; }
	$(PYTHON) -m venv .venv

$(STAMP): pyproject.toml requirements.lock | $(BIN)/python
	sed '/^ *--hash/d; s/ \\$$//' requirements.lock > .venv/constraints.txt # pip cannot hash a checkout
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c .venv/constraints.txt -e '.[$(EXTRAS)]'
	@touch $@

train: $(STAMP)
	$(BIN)/python -m foajax.train $(ARGS)

PYTEST := JAX_PLATFORMS=cpu $(BIN)/python -m pytest -n logical --maxprocesses 4 --dist worksteal

test: $(STAMP)
	$(PYTEST) -m 'not slow' $(TEST_ARGS)

test-slow: $(STAMP)
	$(PYTEST) -m 'slow and not long' $(TEST_ARGS)

test-all: test test-slow
	$(PYTEST) -m long $(TEST_ARGS)

docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

check: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(STAMP)
	for script in $(filter-out benchmarks/soak.py,$(wildcard benchmarks/*.py)); do $(BIN)/python $$script || exit 1; done

soak: $(STAMP)
	$(BIN)/python benchmarks/soak.py $(ARGS)

profile: $(STAMP)
	$(BIN)/python -m foajax.train profile=true $(ARGS)

lock: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	$(BIN)/uv pip compile --universal --python-version 3.11 --all-extras --upgrade --quiet --generate-hashes \
	  --no-emit-index-url --no-header --output-file requirements.lock pyproject.toml

release: $(STAMP)
	rm -rf dist && $(BIN)/python -m build --quiet && $(BIN)/twine check --strict dist/*
	$(BIN)/python -m pip install --quiet --disable-pip-version-check cyclonedx-bom
	$(BIN)/cyclonedx-py requirements requirements.lock -o dist/sbom.json

clean:
	rm -rf .venv .mypy_cache .pytest_cache .ruff_cache build dist
