# `make demo` and `make test` do all set-up in .venv; run again, they set up only what has changed.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
TOOLCHAIN := firmware_host/firmware/install-toolchain.sh
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# Each of the many processes of the tests would read every source again.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help demo test ready lint kernels docs notebooks fuzz sbom release format pictures clean

help:  ## Show this list
	@grep -E '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

demo: $(VENV)/.installed  ## Simulate four stretches of a drive, receive them, compare with the paper; demo-out/
	$(BIN)/evlcp demo

test:  ## Format, lint, types, then every test
	@$(MAKE) -j2 --no-print-directory ready
	$(BIN)/pytest -q -n auto --dist worksteal

# Two at a time: packages for Python and for the firmware are fetched, then types checked and kernels compiled.
ready: lint toolchain kernels

lint: $(VENV)/.dev  ## Format, lint and types only
	$(BIN)/ruff format --check
	$(BIN)/ruff check
	$(BIN)/mypy

# What the tests' workers would each compile at once. Whether it works is theirs to find.
kernels: $(VENV)/.dev
	@$(BIN)/evlcp warm-up >/dev/null 2>&1 || true

docs: $(VENV)/.dev  ## Build the documentation site; site/index.html
	$(BIN)/python -m sphinx -q -W --keep-going -d .sphinx docs site
	@echo "open site/index.html"

notebooks: $(VENV)/.dev  ## Run the notebooks of the docs and keep what they show
	$(BIN)/python docs/run_notebooks.py

MINUTES ?= 5
fuzz: $(VENV)/.dev  ## Damage files of every kind and read them, for MINUTES
	$(BIN)/python -m tests.fuzz --minutes $(MINUTES)

sbom: $(VENV)/.dev  ## Write sbom.json, what the tests run with, from the lock
	$(BIN)/python .ci/sbom.py > sbom.json

release: $(VENV)/.dev  ## Build sdist and wheel, try the wheel on each Python 3.11 to 3.13 there is; dist/
	$(BIN)/python .ci/release.py

format: $(VENV)/.dev  ## Format the code
	$(BIN)/ruff format

pictures: $(VENV)/.installed  ## Draw the pictures of the docs again
	$(BIN)/evlcp demo --recording
	cp demo-out/presence.png demo-out/distance.png docs/images/
	$(BIN)/evlcp video examples/recordings/night-50m-30kmh-cut.raw -o docs/images/film.webp \
	  --for-ms 10 --size 420
	$(BIN)/python docs/figures/how.py docs/images
	$(BIN)/python docs/figures/link.py docs/images/link.svg
	$(BIN)/python docs/figures/packet.py docs/images/packet.svg
	$(BIN)/evlcp simulate examples/scenes/gate.toml -o demo-out/gate.raw
	$(BIN)/evlcp receive demo-out/gate.raw -o demo-out/gate --sites demo-out/gate.site.toml \
	  --attitude demo-out/gate.attitude.csv --figures --report
	cp demo-out/gate/track.png docs/images/
	$(BIN)/python docs/figures/live.py docs/images/live.png demo-out/gate.raw \
	  --sites demo-out/gate.site.toml --attitude demo-out/gate.attitude.csv
	chromium --headless --hide-scrollbars --force-prefers-reduced-motion --window-size=1280,1640 \
	  --screenshot=docs/images/report.png demo-out/gate/report.html
	$(BIN)/python docs/figures/error_correction.py curves --figure docs/images/error-correction.png

clean:  ## Remove .venv and everything that was generated
	rm -rf $(VENV) demo-out loop-out quickstart-out .mypy_cache .pytest_cache .ruff_cache .hypothesis site .sphinx
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Without it the firmware's tests would be skipped: CI takes that for a failure, a developer may go on.
# After the environment, which may call for the system's packages, too.
.PHONY: toolchain
toolchain: | $(BIN)/python
	@if [ -f $(TOOLCHAIN) ]; then bash $(TOOLCHAIN) || { \
	  echo "make: the firmware toolchain is not installed; its tests are skipped"; [ -z "$$CI" ]; }; fi
	@command -v chromium >/dev/null || { \
	  if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then echo "installing chromium"; \
	    apt-get update -qq >/dev/null 2>&1; \
	    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends chromium >/dev/null; fi; \
	  command -v chromium >/dev/null || { \
	    echo "make: chromium is not installed; the test of the report's page is skipped"; [ -z "$$CI" ]; }; }

	@/usr/bin/python3 -c 'import gi; gi.require_version("UMockdev", "1.0")' 2>/dev/null || { \
	  if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then echo "installing umockdev"; \
	    apt-get update -qq >/dev/null 2>&1; \
	    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends \
	      umockdev gir1.2-umockdev-1.0 python3-gi >/dev/null; fi; \
	  /usr/bin/python3 -c 'import gi; gi.require_version("UMockdev", "1.0")' 2>/dev/null || { \
	    echo "make: umockdev is not installed; the tests of the emulated camera are skipped"; [ -z "$$CI" ]; }; }

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "make: Python 3.11 or later is needed, found: $$($(PYTHON) --version 2>&1)."; \
	  echo "make: name another one with: make PYTHON=/path/to/python3"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	  echo "make: this Python lacks the module venv (Debian and Ubuntu: package python3-venv)"; \
	  if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	    apt-get update -q && DEBIAN_FRONTEND=noninteractive apt-get install -q -y python3-venv; \
	  else echo "make: install it with: sudo apt-get install python3-venv"; exit 1; fi; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.pip: | $(BIN)/python
	$(BIN)/python -m pip install -q --upgrade 'pip>=25.1'
	@touch $@

# Most modules are never imported: Python compiles a module when it is, and keeps that.
$(VENV)/.installed: pyproject.toml $(VENV)/.pip
	@echo "environment: $(VENV), by pip ..."
	@$(BIN)/python -m pip install -q --no-compile -e .
	@touch $@

$(VENV)/.dev: pyproject.toml $(VENV)/.pip
	$(BIN)/python -m pip install -q --no-compile -e '.[faery,parquet,pandas,cluster,mcap,live,sign,mp4,camera,ros,hdf5,docs,notebook]' --group dev
	@touch $@ $(VENV)/.installed
