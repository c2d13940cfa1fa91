# make demo: everything from nothing to a table, a picture and a page.  make test: the whole suite.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test test-long coverage benchmarks lint format copy types docs wheel dist clean

demo: .venv/demo.stamp
	$(BIN)/rbl-gym demo --plot out/demo.png --html out/demo.html
	@echo '`. $(BIN)/activate` puts rbl-gym on the path of this shell.'

# Two workers use both cores; more threads of BLAS would wait for one another.
test: .venv/dev.stamp
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal

# What `test` leaves out: whole recordings, more trials.
test-long: .venv/dev.stamp
	$(BIN)/python -m pytest -n 2 -m long

# Twice as long as `test`; lines that no test reaches, and a failure below 95 %.
coverage: .venv/dev.stamp
	$(BIN)/python -m pytest -n 2 --cov --cov-report=term

# Speeds, as ratios to what runs beside; minutes each, on a machine with nothing else to do.
benchmarks: .venv/dev.stamp
	for name in filters iekf static environments; do \
	  $(BIN)/python benchmarks/$$name.py --json out/$$name.json || exit 1; done

lint: .venv/dev.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell

format: .venv/dev.stamp
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# An installed copy: no checker follows the mapping from folders to import names.
copy: .venv/dev.stamp
	rm -rf build/copy build/lib
	$(BIN)/python -m pip install --quiet --no-deps --target build/copy .

types: copy
	cp -r tests pyproject.toml build/copy/
	cd build/copy && ../../$(BIN)/pyrefly check --python-interpreter-path ../../$(BIN)/python

# The site, in build/site; its reference is read from the copy.
docs: copy
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# The wheel, built from the sdist. After the copy: both build in the checkout.
wheel: copy
	rm -rf build/lib build/bdist* dist
	$(BIN)/python -m build --outdir dist .
	$(BIN)/twine check --strict dist/*

# The wheel installed outside the checkout, where the folder mapping has to hold by itself.
dist: wheel
	$(BIN)/python -m venv --clear .venv/smoke
	.venv/smoke/bin/python -m pip install --quiet "$$(ls dist/*.whl)"
	cd "$${TMPDIR:-/tmp}" && "$(CURDIR)/.venv/smoke/bin/python" -W error "$(CURDIR)/tests/smoke.py"

clean:
	rm -rf .venv build dist out *.egg-info .pytest_cache .ruff_cache

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || (echo "rbl-gym needs Python 3.11 or newer: make PYTHON=python3.12 ..." >&2; exit 1)
	$(PYTHON) -m venv .venv

.venv/demo.stamp: pyproject.toml | .venv/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[all]'
	touch $@

.venv/dev.stamp: pyproject.toml | .venv/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $@ .venv/demo.stamp
