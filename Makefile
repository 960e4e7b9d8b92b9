# ir_maniskill: `make help` lists the targets. Every set-up step leaves a stamp in
# $(VENV), so that a second run starts where the first one stopped.

VENV        ?= .venv
PYTHON      ?= python3
TORCH_INDEX ?=
DEMO_TASK   ?= NaoTouchCubeSingle-v1
DEMO_DIR    ?= runs/demo
EPISODES    ?= 100
JOBS        ?= 2

BIN         := $(VENV)/bin
IR          := $(BIN)/ir-maniskill
PACKAGES    := $(VENV)/.stamp-packages
VULKAN      := $(VENV)/.stamp-vulkan
SOURCES     := ir_maniskill ir_maniskill_cli.py tasks assets tests examples scripts docs/make_images.py
PYTEST      := $(BIN)/python -m pytest -n $(JOBS) --dist worksteal

export TORCH_INDEX
.DELETE_ON_ERROR:
.PHONY: help setup demo test test-fast check format docs doctor wheel clean

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 12

# --- set-up -------------------------------------------------------------------

setup: $(VULKAN)  ## make .venv with all packages, and software Vulkan where there is no GPU

$(VENV)/.stamp-venv:
	scripts/create_venv.sh $(VENV) $(PYTHON)
	touch $@

$(VENV)/.stamp-torch: $(VENV)/.stamp-venv
	scripts/install_torch.sh $(VENV) constraints.txt
	touch $@

$(PACKAGES): $(VENV)/.stamp-torch pyproject.toml constraints.txt
	$(BIN)/python -m pip install --constraint constraints.txt --editable '.[dev,docs]'
	touch $@

$(VULKAN): $(PACKAGES)
	scripts/install_vulkan.sh $(VENV)
	touch $@

# --- the demonstration --------------------------------------------------------

demo: $(VULKAN)  ## train NAO to touch the blue cube from images, evaluate it, make a video
	@scripts/demo.sh $(IR) $(DEMO_TASK) $(DEMO_DIR) $(EPISODES)

# --- tests --------------------------------------------------------------------

test: $(VULKAN) check  ## everything CI runs: lint, types, tests, wheel
	$(PYTEST) --durations=10
	scripts/check_wheel.sh $(VENV)

test-fast: $(VULKAN)  ## the tests that are not marked slow
	$(PYTEST) -m "not slow" -q

check: $(PACKAGES)  ## lint, format check and types
	$(BIN)/ruff check $(wildcard $(SOURCES))
	$(BIN)/ruff format --check $(wildcard $(SOURCES))
	$(BIN)/mypy

format: $(PACKAGES)  ## let ruff format and fix what it can
	$(BIN)/ruff check --fix $(wildcard $(SOURCES))
	$(BIN)/ruff format $(wildcard $(SOURCES))

wheel: $(VULKAN)  ## build the wheel, install it in a clean environment, step a task
	scripts/check_wheel.sh $(VENV)

# By their names: pdoc passes over modules that a package's __all__ leaves out.
docs: $(PACKAGES)  ## write the API reference as a site, to docs/site
	find -L ir_maniskill -name '*.py' | sed 's,/__init__.py$$,,; s,\.py$$,,; s,/,.,g' | sort \
	    | xargs $(BIN)/python -W ignore -m pdoc -d google --no-show-source -o docs/site

doctor: $(PACKAGES)  ## say whether this machine can render, and what to install if not
	@$(BIN)/python -I ir_maniskill/doctor.py

clean:  ## remove what make made, except runs/
	rm -rf $(VENV) build dist docs/site *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis
