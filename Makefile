# The verbs that people and CI use. `make up` on a fresh machine needs Python, git, make and a C compiler.
.PHONY: install debian up test test-compose check bench reproduce soak mutants docs
.DEFAULT_GOAL := install

PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed
FOLDERS := core hw sim plant_service robot_service console lab tests
ARGS ?=
# With tests named in ARGS, one of the two halves may hold none of them (pytest's exit code 5).
OR_NONE = $(if $(ARGS),|| [ $$? -eq 5 ])

install: $(STAMP)

$(STAMP): pyproject.toml uv.lock
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' \
	  || { echo "Python 3.11 to 3.13 is needed; name one: make PYTHON=python3.12"; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@test -x $(BIN)/uv || $(BIN)/python -m pip install --quiet "uv>=0.9,<1"
	$(BIN)/uv sync --frozen --compile-bytecode --extra dev --extra conformance --extra bench --extra cluster --extra discovery --extra record
	$(BIN)/python -m console.warm
	@touch $@

# What some tests and the example use of Debian, as root; the garden itself needs none of it.
debian:
	apt-get update
	apt-get install --no-install-recommends -y babeld iproute2 strace
	$(MAKE) -C examples/cgi-pot install

up: $(STAMP)
	@exec $(BIN)/garden up $(ARGS)

test: $(STAMP)
	$(BIN)/python -m pytest -m "not soak and not compose and not alone" --numprocesses auto --dist worksteal $(ARGS) $(OR_NONE)
	$(BIN)/python -m pytest -m "alone and not soak and not compose" $(ARGS) $(OR_NONE)

test-compose: $(STAMP)
	$(BIN)/python -m pytest -m compose tests/compose -s $(ARGS)

check: $(STAMP)
	$(BIN)/ruff check $(FOLDERS)
	$(BIN)/ruff format --check $(FOLDERS)
	$(BIN)/mypy

bench: $(STAMP)
	$(BIN)/garden bench $(ARGS)

reproduce: $(STAMP)
	$(BIN)/python -m lab.report $(ARGS)

soak: $(STAMP)
	$(BIN)/python -m pytest -m "soak and not alone" --numprocesses auto --dist worksteal --durations=0 $(ARGS) $(OR_NONE)
	$(BIN)/python -m pytest -m "soak and alone" --durations=0 $(ARGS) $(OR_NONE)

mutants: $(STAMP)
	$(BIN)/python -m lab.mutants $(ARGS)

docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet
