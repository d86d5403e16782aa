# Commands for developers. `make` or `make help` lists the targets.
# A fresh Debian needs: apt install make python3 python3-venv

PYTHON ?= python3
# Extra pip options for torch only, e.g. --extra-index-url https://download.pytorch.org/whl/cpu without a GPU.
TORCH_FLAGS ?=
# Further options for pytest, and its number of processes: `make test ARGS="-k melt" JOBS=0`.
ARGS ?=
JOBS ?= auto

# Whether `make site` draws elements and tasks.
PICTURES ?= yes

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
INSTALL := $(PIP) --constraint constraints.txt
TORCH := $(shell sed -n 's/^torch==//p' constraints.txt)

# One thread per process: pytest runs several processes, and small tensors gain nothing from threads.
test test-all golden: export OMP_NUM_THREADS ?= 1

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup demo test test-all check lint types format golden web vscode wheel site release clean distclean mutation fuzz

help:  ## list these targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/\1|\2/p' $(MAKEFILE_LIST) | while IFS='|' read -r name about; do printf '  make %-10s %s\n' "$$name" "$$about"; done

# Two stamps: packages for running, and those for development. Repeated calls are instant.
# torch comes first and by exact version: a range would take the newest release, including gigabytes of CUDA.
$(VENV)/.core: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "powderdsl needs Python 3.11 or newer; try: make PYTHON=python3.11 $(MAKECMDGOALS)" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip' || { echo "Python's venv module is missing; on Debian: apt install python3-venv" >&2; exit 1; }
	@echo "setting up $(VENV): torch $(TORCH) and powderdsl (a minute or two, once)"
	@test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV)
	@$(PIP) $(TORCH_FLAGS) torch==$(TORCH)
	@$(INSTALL) hatchling
	@$(INSTALL) --no-build-isolation --editable .
	@touch $@

$(VENV)/.ready: $(VENV)/.core
	@echo "setting up $(VENV): tools for tests, checks, training, video and clusters"
	@$(INSTALL) --no-build-isolation --editable '.[dev,lsp,minari,ray,rl,sb3-contrib,torchrl,video]'
	@touch $@

$(VENV)/.docs: $(VENV)/.ready
	@$(INSTALL) --no-build-isolation --editable '.[docs]'
	@touch $@

tests/web/node_modules: tests/web/package-lock.json
	@command -v npm >/dev/null || { echo "npm is missing: install Node.js 20 or newer" >&2; exit 1; }
	@npm ci --prefix tests/web --no-audit --no-fund --loglevel error
	@touch $@

setup: $(VENV)/.ready  ## create .venv with all development tools

demo: $(VENV)/.core  ## run a designed world and write demo.gif
	@$(BIN)/powderdsl run powderworld --world garden --steps 240 --out demo.gif
	@echo "$(CURDIR)/demo.gif"

web: tests/web/node_modules  ## fetch Pyodide and the editor, for `powderdsl play`, the wheel and the tests
	@node tests/web/parts.mjs

vscode:  ## build dist/powderdsl.vsix, the extension for VS Code
	@mkdir -p dist
	@cd editors/vscode && npm ci --no-audit --no-fund --loglevel=error && npm run --silent package

test: $(VENV)/.ready  ## run the tests (ARGS=... for pytest, JOBS=0 for one process)
	@$(BIN)/python -m pytest --numprocesses $(JOBS) --maxprocesses 4 --dist worksteal $(ARGS)

test-all: $(VENV)/.ready  ## run the slow tests too: long searches for mistakes (hours)
	@$(BIN)/python -m pytest --slow --numprocesses $(JOBS) --maxprocesses 4 --dist worksteal --durations 20 $(ARGS)

check: lint types test  ## lint, types and test

lint: $(VENV)/.ready  ## run ruff: lint and format check
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .

types: $(VENV)/.ready  ## mypy over the package
	@$(BIN)/mypy

format: $(VENV)/.ready  ## format the code as `make lint` requires
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

mutation: $(VENV)/.ready  ## judge all mutants of the shipped packs, and write the table of docs/testing.md (minutes)
	@$(BIN)/python docs/mutation_table.py --jobs $$(nproc)

fuzz: $(VENV)/.ready  ## compare all backends on random rules and worlds (ARGS="--seconds 60"; ARGS=--help)
	@$(BIN)/python -m tests.fuzz $(ARGS)

golden: $(VENV)/.ready  ## rewrite the golden files; read the diff before committing it
	@$(BIN)/python -m pytest --quiet -m golden --update-golden $(ARGS)
	@git status --short tests

wheel: $(VENV)/.ready  ## build dist/*.whl
	@$(BIN)/python -c 'from powderdsl.web.site import write_made; write_made()'
	@$(BIN)/python -m build --wheel --no-isolation
	@ls -l dist/*.whl

site: $(VENV)/.docs  ## build the documentation in site/, with the playground (PICTURES=no: without films, in a minute)
	@NO_MKDOCS_2_WARNING=1 PICTURES=$(PICTURES) $(BIN)/mkdocs build --strict --quiet
	@if test -d powderdsl/web/parts; then $(BIN)/powderdsl play --no-open --export site/play; \
	else echo 'site/play/ is only a stub: `make web` fetches the playground' >&2; fi
	@$(BIN)/python docs/check_site.py site

release: $(VENV)/.ready web  ## build and check dist/*.tar.gz and dist/*.whl, for PyPI
	@$(INSTALL) --no-build-isolation --editable '.[release]'
	@rm -rf dist
	@$(BIN)/python -c 'from powderdsl.web.site import write_made; write_made()'
	@$(BIN)/python -m build --no-isolation
	@$(BIN)/twine check --strict dist/*
	@$(BIN)/python -m tests.release dist/*

clean:  ## remove build products, except .venv
	@rm -rf build dist site .site demo.gif .pytest_cache .mypy_cache .ruff_cache .hypothesis
	@find powderdsl tests -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean  ## clean, and remove what `make setup` and `make web` installed
	@rm -rf $(VENV) tests/web/node_modules
