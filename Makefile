# make install | quickstart | unit | test | docs: each prepares what it needs and can be repeated.
PYTHON ?= python3
PIP_ARGS ?=
VENV := .venv
BIN := $(VENV)/bin

.PHONY: install quickstart smoke unit test check docs clean
install: $(VENV)/installed

$(VENV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	@echo "installing PyTorch ..."
	$(BIN)/python -m pip install --quiet $(PIP_ARGS) --constraint constraints.txt torch
	@echo "installing oodil and what it needs ..."
	$(BIN)/python -m pip install --quiet $(PIP_ARGS) --constraint constraints.txt --editable ".[test]"
	$(BIN)/python -m pip install --quiet $(PIP_ARGS) --constraint constraints.txt --no-deps robosuite  # docs/decisions.md
	@touch $@
	@echo "installed; try: $(BIN)/oodil --help"

quickstart: install
	$(BIN)/oodil run configs/quickstart.yaml

smoke: install
	$(BIN)/oodil run configs/smoke.yaml

check: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

unit: install
	$(BIN)/python -m pytest -n 2 -m "not slow" tests/unit tests/property

test: check
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

docs: $(VENV)/docs
	$(BIN)/python -m sphinx -W --keep-going -E -q -c docs . build/docs
	@echo "build/docs/index.html"

$(VENV)/docs: $(VENV)/installed
	$(BIN)/python -m pip install --quiet $(PIP_ARGS) --constraint constraints.txt --editable ".[docs]"
	@touch $@

clean:
	rm -rf $(VENV) runs build *.egg-info
