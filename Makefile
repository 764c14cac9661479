# Two commands: `make run` and `make test`. Both set up what they need, as do the others.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
VERSIONS := tests/constraints.txt

# Written byte code: tests start many processes, each of which would compile the package and pytest's assertions.
unexport PYTHONDONTWRITEBYTECODE

# Workers get stretches of tests that follow each other, and share what a file's tests share (servers, folded logs).
# Threads of OpenBLAS wait for each other by spinning, on processors that other tests need.
PYTEST := OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist worksteal

# Tests of what is written in vector instructions, which LLVM splits where a processor's vectors are shorter.
VECTORS := simd simd_rows linalg inverse_root symmetric

.PHONY: run test lint fast release generic versions lowest newest bench shots docs size upgrade clean

run: $(VENV)/.installed
	$(BIN)/nisus run motor_can

# Compiles first what tests share: two workers that need the same filter at once would both compile it.
test: $(VENV)/.installed-dev
	$(BIN)/python -m tests.warm
	$(PYTEST)

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m tests.size --check

# A minute of the tests nearest to what differs from main, by imports.
fast: $(VENV)/.installed-dev
	arguments=$$($(BIN)/python -m tests.affected) && $(PYTEST) -m "not browser" -x -q $$arguments

# What takes long and seldom fails, before a release: guides as a site and their commands, figures of all recordings,
# other processors, and other versions of Python and of all packages.
release: lint test docs generic versions
	$(PYTEST) -m release
	$(BIN)/nisus guard --junit guard.xml

# On a processor without AVX or FMA; Numba's cache keeps its machine code apart.
generic: $(VENV)/.installed-dev
	NUMBA_CPU_NAME=generic $(PYTEST) -q $(VECTORS:%=tests/estimators/numerics/test_%.py)

# The lowest versions that pyproject.toml allows on the oldest Python here, and the newest on the newest.
versions: lowest newest

lowest newest: $(VENV)/.installed-dev
	$(BIN)/python -m tests.versions $@

# In an environment of its own: a peer installs a package `tests`.
bench: $(VENV)-bench/.installed
	$(VENV)-bench/bin/python -m tests.benchmarks

# The README's pictures, from the running page.
shots: $(VENV)/.installed-dev
	$(BIN)/python -m tests.shots

# The guides as a site in build/docs; a broken link or reference is an error. Their examples run in tests/docs.
docs: $(VENV)/.installed-dev
	$(BIN)/python -m sphinx -q -W --keep-going -b html docs build/docs

# Files, lines and tokens per package, and their budgets; of another revision: `python -m tests.size REVISION`.
size: $(VENV)/.installed-dev
	$(BIN)/python -m tests.size

# The newest versions of all packages from now on; run `make release` then.
upgrade: $(VENV)/.installed-dev
	$(BIN)/python -m uv pip compile --quiet --upgrade --universal --python-version 3.11 --all-extras \
	    --no-annotate --custom-compile-command 'make upgrade' --output-file $(VERSIONS) pyproject.toml

%/bin/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Nisus needs Python 3.11 or later; try: make PYTHON=python3.11")'
	$(PYTHON) -m venv $*

INSTALL = -m pip install --quiet --disable-pip-version-check --constraint $(VERSIONS) --editable

$(VENV)/.installed: pyproject.toml $(VERSIONS) | $(VENV)/bin/python
	$(BIN)/python $(INSTALL) .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(BIN)/python $(INSTALL) '.[dev]'
	touch $@

$(VENV)-bench/.installed: pyproject.toml $(VERSIONS) | $(VENV)-bench/bin/python
	$(VENV)-bench/bin/python $(INSTALL) '.[dev,bench]'
	touch $@

clean:
	rm -rf $(VENV) $(VENV)-bench *.egg-info build dist
