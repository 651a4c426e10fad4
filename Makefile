PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
COMMA := ,
# tests and studies use processes, not BLAS threads
export OPENBLAS_NUM_THREADS ?= 1
# workers of the tests: one more than the two cores, since tests of the bus wait a good part of their time
WORKERS ?= 3
# the package as it is installed, by links: pyrefly and import-linter look at folders and do not ask setuptools
PACKAGE := build/imports/triline

.PHONY: help demo test docs lint bench study lowest schemas golden clean

help:
	@echo "make demo    live on-line triangulation of a simulated flight (headless where there is no display)"
	@echo "make test    all tests"
	@echo "make lint    ruff, type checker, import contract"
	@echo "make bench   benchmarks of speed; writes their tables into docs/benchmarks.md"
	@echo "make docs    the documentation as a site, in build/docs"
	@echo "make study   slow statistical studies and the fuzz campaign; hours"
	@echo "make lowest  all tests with the lowest versions that pyproject.toml allows"
	@echo "make schemas compile the protobuf files"
	@echo "make golden  make the golden recording and its results anew"

# A virtual environment with the package, $(1); made again when the dependencies change. pip would compile byte code on one
# core, and that of the packages' own tests, too. With triline compiled here, its processes need not do it one by one.
define install
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --no-compile --editable '$(1)'
	-@$(BIN)/python -m compileall -qq -j 0 -x '/tests?/' $(VENV)/lib nodes schemas solver >/dev/null
	@touch $@
endef

$(VENV)/.run: pyproject.toml
	$(call install,.)

$(VENV)/.dev: pyproject.toml
	$(call install,.[dev])
	@touch $(VENV)/.run

$(VENV)/.bench: pyproject.toml
	$(call install,.[dev$(COMMA)bench])
	@touch $(VENV)/.run $(VENV)/.dev

$(VENV)/.docs: pyproject.toml
	$(call install,.[docs])
	@touch $(VENV)/.run

demo: $(VENV)/.run
	$(BIN)/triline demo

test: $(VENV)/.dev
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal

docs: $(VENV)/.docs
	$(BIN)/python -m sphinx -q -b html docs build/docs
	@echo "build/docs/index.html"

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	rm -rf $(PACKAGE)
	mkdir -p $(PACKAGE)
	ln -s $(addprefix $(CURDIR)/,nodes schemas solver triline/__init__.py) $(PACKAGE)
	$(BIN)/pyrefly check --python-interpreter-path $(BIN)/python
	cd $(PACKAGE)/.. && $(abspath $(BIN))/lint-imports --config $(CURDIR)/pyproject.toml --no-cache

bench: $(VENV)/.bench
	$(BIN)/python bench/run.py

study: $(VENV)/.bench
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal -m study
	$(BIN)/python bench/run.py --studies --long
	$(BIN)/triline study all

# the oldest dependencies that pyproject.toml names, in an environment of their own
lowest:
	$(PYTHON) -m venv .venv-lowest
	.venv-lowest/bin/python -m pip install --quiet uv
	VIRTUAL_ENV=.venv-lowest .venv-lowest/bin/uv pip install --quiet --resolution lowest-direct --editable '.[dev]'
	PATH="$(CURDIR)/.venv-lowest/bin:$$PATH" .venv-lowest/bin/python -m pytest -n $(WORKERS) --dist worksteal

golden: $(VENV)/.dev
	$(BIN)/python recordings/golden.py

schemas: $(VENV)/.dev
	$(BIN)/python schemas/compile.py

clean:
	rm -rf build dist out *.egg-info
