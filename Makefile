# Two commands: `make run` and `make test`. Both set up what they need, as do the others.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

# A file's tests stay on one worker, which keeps what they share (servers, recordings, folded logs).
PYTEST := $(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile

# Tests of what is written in vector instructions, which LLVM splits where a processor's vectors are shorter.
VECTORS := simd simd_rows linalg inverse_root symmetric

.PHONY: run test types warm fast generic versions lowest newest bench shots docs size clean

run: $(VENV)/.installed
	$(BIN)/nisus run motor_can

test: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(MAKE) --jobs types docs warm
	$(BIN)/nisus guard --junit guard.xml
	$(PYTEST)

types: $(VENV)/.installed-dev
	$(BIN)/mypy

# Compiles what tests share; types and guides are checked beside it, each on one processor.
warm: $(VENV)/.installed-dev
	$(BIN)/python -m tests.warm

# The quickest tests, so many that they take 100 s of a processor by the runs before; all, if there was none.
fast: $(VENV)/.installed-dev
	$(PYTEST) -m "not browser" --quickest 100 -x -q

# On a processor without AVX or FMA; Numba's cache keeps its machine code apart.
generic: $(VENV)/.installed-dev
	NUMBA_CPU_NAME=generic $(PYTEST) -q $(VECTORS:%=tests/estimators/numerics/test_%.py)

# The lowest versions that pyproject.toml allows on the oldest Python here, and the newest on the newest.
versions: lowest newest

lowest newest: $(VENV)/.installed-dev
	$(BIN)/python -m tests.versions $@

bench: $(VENV)/.installed-dev
	$(BIN)/python -m tests.benchmarks

# The README's pictures, from the running page.
shots: $(VENV)/.installed-dev
	$(BIN)/python -m tests.shots

# The guides as a site in build/docs; a broken link or reference is an error. Their examples run in tests/docs.
docs: $(VENV)/.installed-dev
	$(BIN)/python -m sphinx -q -W --keep-going -b html docs build/docs

# Lines and files per package; of another revision: `python -m tests.size REVISION`.
size: $(VENV)/.installed-dev
	$(BIN)/python -m tests.size

$(VENV)/bin/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Nisus needs Python 3.11 or later; try: make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet -e .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet -e '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) *.egg-info build dist
