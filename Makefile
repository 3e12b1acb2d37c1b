# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
CLOUD ?=
OUT ?= demo
MINUTES ?= 30
N ?= 200
# Errors only; and Python compiles what is imported when it is, which is a tenth of what pip would compile for a minute.
# It has to keep that, or each process would compile all of PyTorch anew: four seconds, of which a test run has hundreds.
export PYTHONDONTWRITEBYTECODE :=
PIP := $(BIN)/python -m pip install --quiet --quiet --no-compile --disable-pip-version-check -c constraints.txt

.PHONY: demo test test-all fuzz kills lint docs clean

# What using it needs; the stamps below add what developing it and its site need.
$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) -e .
	touch $@

$(VENV)/.dev: $(VENV)/.installed
	$(PIP) -e '.[dev]'
	touch $@

demo: $(VENV)/.installed
	$(BIN)/mplicits demo $(CLOUD) -o $(OUT)

# Two processes of one thread each: most tests are too small to share. Each has whole files at first, whose fixtures are
# made once for that, and takes from the other when it has none left.
test: lint
	@command -v chromedriver >/dev/null || echo "the tests of pages are skipped: no Chromium; on Debian: apt-get install chromium chromium-driver"
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal

test-all: lint
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal -m ''

fuzz: $(VENV)/.dev
	$(BIN)/python tests/fuzz/hunt.py --minutes $(MINUTES)

kills: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/python tests/kills.py --number $(N)

# The type checker does not follow setuptools' names of folders, which benchmarks import: it finds them by links.
lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	mkdir -p build/types/mplicits
	ln -sfn $(addprefix ../../../,configs datasets neural_fields pipelines) build/types/mplicits
	$(BIN)/basedpyright --pythonpath $(BIN)/python

$(VENV)/.docs: $(VENV)/.installed
	$(PIP) -e '.[docs]'
	touch $@

docs: $(VENV)/.docs
	rm -rf $(filter-out build/types,$(wildcard build/*)) site
	$(PIP) --no-deps --target build/api .
	$(BIN)/mkdocs build

clean:
	rm -rf $(VENV) build dist site *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
