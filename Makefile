# `make run` and `make test` do all the set-up; nothing else needs to be known.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
RUN := .venv/.run-ready
DEV := .venv/.dev-ready

.PHONY: run test test-integration test-exam test-slow lint docs gallery prove bench clean lock

# The diagnosis works on one core and takes longer than the training, which gives way to it (nice); its lines follow at
# the end.
run: $(RUN)  ## the main job on the built-in sample year, and a sealed demonstration of the diagnosis
	@mkdir -p var
	$(BIN)/thermodrift demonstrate > var/demonstration.txt 2>&1 & demonstration=$$!; trap 'kill $$demonstration 2>/dev/null' EXIT; \
	$(BIN)/thermodrift simulate --sample-year --out var/sample_year \
	&& nice -n 5 $(BIN)/thermodrift train --machine machines/sample_vmc.yml --recordings var/sample_year --effort quick \
	&& { wait $$demonstration; ended=$$?; cat var/demonstration.txt; exit $$ended; }

# With bytecode, since many tests start processes.
PYTEST := PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2

test: $(DEV)  ## every test without a marker
	$(PYTEST) --dist loadfile -m "not slow and not integration"

test-integration: $(DEV)  ## those with a browser, a server, another process, a whole diagnosis or a real machine
	$(PYTEST) --dist loadfile -m "integration and not slow"

EXAM ?= exam/tests
test-exam: $(DEV)  ## those of the examination, which no user at a machine runs
	$(PYTEST) --dist loadfile $(EXAM)

test-slow: $(DEV)  ## those of both that take minutes, about 35 on two cores, with the integration tests; before a release
	$(PYTEST) --dist load -m "slow or integration" tests exam/tests

lint: $(DEV)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -q tests/test_language.py

docs: $(DEV)  ## the site in var/site, which opens from disk; a broken link or an external script is an error
	$(BIN)/python -m docs.pictures
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "open var/site/index.html"

gallery: $(DEV)  ## runs every script of docs/gallery and renews its picture; about four minutes
	OMP_NUM_THREADS=1 $(BIN)/python -m docs.gallery

prove: $(DEV)  ## the diagnosis examined on 60 concealed cases that nobody has seen; about half an hour on two cores
	$(BIN)/thermodrift prove --cases 60 --suite development --out var/proof/$$(date -u +%Y%m%d-%H%M%S)

bench: $(DEV)  ## one table of all performance figures; `python -m benchmarks --quick` takes small sizes
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks
	$(BIN)/python -m benchmarks.calibration
	$(BIN)/python -m benchmarks.twin_families
	$(BIN)/python -m benchmarks.diagnosis

clean:
	rm -rf .venv var .mypy_cache .ruff_cache .hypothesis *.egg-info

# What pip would install into an empty environment, as NAME==VERSION.
RESOLVE := $(BIN)/pip install --quiet --disable-pip-version-check --dry-run --ignore-installed --no-build-isolation --report -
PINS := $(BIN)/python -c 'import json, sys; print(*sorted(("{name}=={version}".format(**i["metadata"]).partition("+")[0] for i in json.load(sys.stdin)["install"] if not i["is_direct"]), key=str.lower), sep="\n")'

lock: $(RUN)  ## renew both lock files within the ranges of pyproject.toml
	(echo "# What the program needs, with all that this needs, within pyproject.toml's ranges; \`make lock\` renews it."; \
	 $(RESOLVE) -e . setuptools uv | $(PINS)) > .venv/new.lock && mv .venv/new.lock requirements.lock
	(echo "# What tests, lint, examination, documentation and extras need beyond requirements.lock; \`make lock\` renews it."; \
	 $(RESOLVE) -c requirements.lock -e '.[dev]' -e './exam[proof]' | $(PINS) | grep -vxFf requirements.lock) \
	 > .venv/new.lock && mv .venv/new.lock requirements-dev.lock

# What is imported is compiled at its first use: compiling every module of every package takes a third of the set-up.
INSTALL := $(BIN)/pip install --quiet --disable-pip-version-check --no-compile
EDITABLE := $(INSTALL) --no-deps --no-build-isolation -e
# uv is several times as fast. It does not read pip's settings, so it gets them as its own; those of the environment last.
UV_SETTINGS := export UV_INDEX_STRATEGY=unsafe-best-match UV_SYSTEM_CERTS=1; \
	eval "$$($(BIN)/pip config list | sed 's/^:env:/z/' | sort | sed -nE 's/\\n/ /g; s/=(.) +/=\1/; /find-links=/s/ +/,/g; \
	s/^(global|install|z)\.index-url=/export UV_DEFAULT_INDEX=/p; s/^(global|install|z)\.extra-index-url=/export UV_INDEX=/p; \
	s/^(global|install|z)\.find-links=/export UV_FIND_LINKS=/p; s/^(global|install|z)\.cert=/export SSL_CERT_FILE=/p; \
	s/^(global|install|z)\.trusted-host=/export UV_INSECURE_HOST=/p; s/^(global|install|z)\.proxy=/export ALL_PROXY=/p')"
# A lock file. torch is left to pip: its settings decide between a build for the processor and one with gigabytes for
# graphics cards, with whatever that needs. pip also installs what uv has not.
define locked
	@echo "installing $(1)"
	@{ $(INSTALL) $$(grep '^uv==' requirements.lock) && $(UV_SETTINGS) && grep -v '^torch==' $(1) > .venv/uv.lock && \
	  $(BIN)/uv pip install --quiet --python $(BIN)/python --no-deps -r .venv/uv.lock; } || echo "without uv, pip installs $(1): minutes"
	$(INSTALL) -c requirements.lock -r $(1)
endef

$(RUN): requirements.lock pyproject.toml exam/pyproject.toml
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(None if v == (3, 11) else f"thermodrift needs Python 3.11, got {v[0]}.{v[1]}; call make PYTHON=/path/to/python3.11")'
	$(PYTHON) -m venv .venv
	$(call locked,requirements.lock)
	$(EDITABLE) . -e ./exam
	@touch $@

$(DEV): requirements-dev.lock $(RUN)
	$(call locked,requirements-dev.lock)
	@touch $@
