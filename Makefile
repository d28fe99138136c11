# make quickstart | install | unit | test | docs: each prepares what it needs and can be repeated.
PYTHON ?= python3
PIP_ARGS ?=
VENV := .venv
BIN := $(VENV)/bin
PIP = $(BIN)/python -m pip install --quiet $(PIP_ARGS) --constraint constraints.txt
# Nothing here uses a GPU, and elsewhere PyTorch's ordinary build is without one.
CPU_BUILD := $(if $(filter Linux,$(shell uname)),--index-url https://download.pytorch.org/whl/cpu)

.PHONY: install quickstart smoke unit test check docs clean
install: $(VENV)/developed

$(VENV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	@echo "installing PyTorch ..."
	@$(PIP) $(CPU_BUILD) --retries 0 --no-deps torch 2>/dev/null || $(PIP) torch
	@echo "installing oodil and what it needs ..."
	$(PIP) --editable .
	@touch $@
	@echo "installed; try: $(BIN)/oodil --help"

$(VENV)/developed: $(VENV)/installed
	@echo "installing what the tests need ..."
	$(PIP) --editable ".[test]"
	$(PIP) --no-deps robosuite  # docs/decisions.md
	@touch $@

quickstart: $(VENV)/installed
	$(BIN)/oodil run configs/quickstart.yaml

smoke: $(VENV)/installed
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
	$(PIP) --editable ".[docs]"
	@touch $@

clean:
	rm -rf $(VENV) runs build *.egg-info
