# `make run` and `make test` do all the set-up; nothing else needs to be known.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
READY := .venv/.ready
FREEZE := $(BIN)/pip freeze --all --exclude-editable | grep -v '^pip==' | sed 's/+cpu$$//' | sort -f

.PHONY: run test test-exam test-slow lint docs gallery prove bench clean lock

# The diagnosis works on one core, so the demonstration runs while the training does; its lines follow at the end.
run: $(READY)  ## the main job on the built-in sample year, and a sealed demonstration of the diagnosis
	$(BIN)/thermodrift simulate --sample-year --out var/sample_year
	$(BIN)/thermodrift demonstrate > var/demonstration.txt 2>&1 & demonstration=$$!; trap 'kill $$demonstration 2>/dev/null' EXIT; \
	$(BIN)/thermodrift train --machine machines/sample_vmc.yml --recordings var/sample_year --effort quick \
	&& { wait $$demonstration; ended=$$?; cat var/demonstration.txt; exit $$ended; }

test: $(READY)  ## with bytecode, since many tests start processes
	PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile

EXAM ?= exam/tests
test-exam: $(READY)  ## those of the examination, which no user at a machine runs
	PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile $(EXAM)

test-slow: $(READY)  ## those of both that take minutes, about 35 on two cores; before a release
	PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist load -m slow tests exam/tests

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -q tests/test_language.py

docs: .venv/.docs-ready  ## the site in var/site, which opens from disk; a broken link or an external script is an error
	$(BIN)/python -m docs.pictures
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "open var/site/index.html"

gallery: $(READY)  ## runs every script of docs/gallery and renews its picture; about four minutes
	OMP_NUM_THREADS=1 $(BIN)/python -m docs.gallery

prove: $(READY)  ## the diagnosis examined on 60 concealed cases that nobody has seen; about half an hour on two cores
	$(BIN)/thermodrift prove --cases 60 --suite development --out var/proof/$$(date -u +%Y%m%d-%H%M%S)

bench: $(READY)  ## one table of all performance figures; `python -m benchmarks --quick` takes small sizes
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks
	$(BIN)/python -m benchmarks.calibration
	$(BIN)/python -m benchmarks.twin_families
	$(BIN)/python -m benchmarks.diagnosis

clean:
	rm -rf .venv var .mypy_cache .ruff_cache .hypothesis *.egg-info

lock: $(READY)  ## renew the lock files within the ranges of pyproject.toml
	$(BIN)/pip install --quiet --upgrade --upgrade-strategy eager -e '.[dev]'
	sed -n 's/==.*/==/p' requirements-docs.lock > .venv/docs-names
	(echo "# Every direct and indirect version, within pyproject.toml's ranges; \`make lock\` renews it."; \
	 $(FREEZE) | grep -viFf .venv/docs-names) > .venv/new.lock && mv .venv/new.lock requirements.lock
	$(BIN)/pip install --quiet --upgrade -c requirements.lock -e '.[docs]'
	(echo "# What \`make docs\` needs beyond requirements.lock; \`make lock\` renews it."; \
	 $(FREEZE) | grep -vxFf requirements.lock) > .venv/new.lock && mv .venv/new.lock requirements-docs.lock

# What is imported is compiled at its first use: compiling every module of every package takes a third of the set-up.
$(READY): requirements.lock pyproject.toml exam/pyproject.toml
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(None if v == (3, 11) else f"thermodrift needs Python 3.11, got {v[0]}.{v[1]}; call make PYTHON=/path/to/python3.11")'
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --no-compile -r requirements.lock
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e . -e ./exam
	@touch $@

.venv/.docs-ready: requirements-docs.lock $(READY)
	$(BIN)/pip install --quiet --disable-pip-version-check --no-compile -r requirements-docs.lock
	@touch $@
