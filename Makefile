# make demo    learn with and without transfer; figure, table, video in demo_output/
# make test    the tests that are quick   make test-all   all of them   make test-oldest   quick ones, oldest Numba and NumPy
# make build   wheel and source distribution in dist/   make smoke   install wheel and source distribution into an empty environment, and try them
# make bench   speed and memory                make lint, type, format, check-codestyle, commit-checks   as in Stable-Baselines3
# make reproduce   the figures and tables of the COMBREL paper, with controls, in reproduction/; REPRODUCE_ARGS="fig2 --runs 2"
# make results   takes what was reproduced, and the results of the benchmark, into docs/
# make benchmark   methods of transfer on pairs of tasks, in benchmark/; BENCHMARK_ARGS="--pairs icub --seeds 3"
# make icub    of these Figure 5, the arm of the iCub with and without transfer from its torso, with the defaults
# make icub-video  learn the iCub's tasks; video and picture of each in icub_output/
# make learner the learner on all tasks, as in docs/results/learner.md (an hour)
# make transfer  the suite's transfer methods and sources, as in docs/results/transfer.md (six hours)
# make suite   tasks, settings and transfer methods of your choice; SUITE_ARGS="--tasks MountainCar4D --seeds 0-2"
# make tutorials   execute all cells of tutorials/, and renew the outputs and figures in them
# make doc     the documentation as HTML, in docs/_build; any warning is an error
# make figures the figures of README.md and docs/; make dashboard the screenshots of TensorBoard
#
# Each of them first installs what it needs into .venv, at the versions in constraints.txt, with uv if there is one. Variables:
#   PYTHON=python3.12  the interpreter          VENV=path  another environment, which make may delete    UV=  pip, not uv
#   TORCH_INDEX=       PyTorch from PyPI        PIP_INDEX_URL, PIP_EXTRA_INDEX_URL and uv's UV_...: indexes of your own
SHELL := /bin/bash

VENV ?= .venv
BIN := $(VENV)/bin
PYTEST_WORKERS ?= 2
DEMO_ARGS ?=
REPRODUCE_ARGS ?= all
BENCHMARK_ARGS ?=
ICUB_ARGS ?=
SUITE_ARGS ?=
LINTED := sb3_combrel envs tests
CONSTRAINTS ?= constraints.txt
# The oldest Numba allowed has no wheel for Python 3.13.
OLDEST_PYTHON ?= python3.11

SUPPORTED := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))
ifndef PYTHON
PYTHON := $(shell for python in python3 python3.12 python3.11 python3.13 python; do \
	$$python -c '$(SUPPORTED)' 2>/dev/null && { echo $$python; break; }; done)
endif

# Without this NumPy's and PyTorch's threads of parallel runs fight for the cores.
export OMP_NUM_THREADS := 1

.PHONY: demo doc figures dashboard learner transfer suite tutorials reproduce benchmark results icub icub-video test test-all test-oldest bench lint type format check-codestyle commit-checks build smoke gl clean

demo: $(VENV)/.installed-demo
	$(BIN)/sb3-combrel demo $(DEMO_ARGS)

figures: demo
	mkdir -p docs/figures
	cp demo_output/learning_curves.png docs/figures/
	$(BIN)/python -m sb3_combrel.experiments.concept

# Needs Chromium (Debian: chromium).
dashboard: $(VENV)/.installed-demo
	$(BIN)/python -m sb3_combrel.experiments.dashboard dashboard
	mkdir -p docs/figures
	cp dashboard/custom_scalars.png docs/figures/tensorboard_custom_scalars.png
	cp dashboard/images.png docs/figures/tensorboard_images.png

# A later call goes on with what is there.
reproduce: $(VENV)/.installed-demo
	$(BIN)/sb3-combrel reproduce $(REPRODUCE_ARGS)

# A later call goes on with what is there.
benchmark: $(VENV)/.installed-demo
	$(BIN)/sb3-combrel benchmark $(BENCHMARK_ARGS)

# Executes all tutorials and renews their outputs and figures.
tutorials: $(VENV)/.installed-all gl
	$(BIN)/python -m sb3_combrel.experiments.warm_up
	$(BIN)/python -m sb3_combrel.experiments.tutorials

# Takes what was reproduced, and the results of the benchmark, into docs/.
results:
	$(BIN)/python -m sb3_combrel.experiments.pages

# A later call goes on with what is there. ICUB_ARGS="--runs 3 --episodes 100", for instance.
icub: $(VENV)/.installed-demo
	$(BIN)/sb3-combrel reproduce fig5 --setting best $(ICUB_ARGS)

# The tasks of docs/results/protocol.md, without transfer. A later call goes on with what is there.
LEARNER_TASKS := MountainCar4D-60 MountainCar2D MountainCar2D-noisy MountainCar-v0 MountainCar-v0-noisy Acrobot-v1 CartPole-v1 \
	Pendulum-v1 MountainCarContinuous-v0 dm_control-pendulum dm_control-cart-pole ICubTorso ICubTorso-noisy ICubArm ICubArm-noisy \
	MountainCar6D PointRobot2D PointRobot3D PointRobot3D-exact PointRobot3D-random
learner: $(VENV)/.installed-demo
	$(BIN)/python -m sb3_combrel.experiments.suite.command --output learner --first-seed 21000 --tasks $(LEARNER_TASKS) $(SUITE_ARGS)

# A later call goes on with what is there; see docs/results/protocol.md.
TRANSFERRED := $(BIN)/python -m sb3_combrel.experiments.suite.command --evaluation-episodes 20 --first-seed 22000
PARTS := effects:transfer=COMBREL-effects bound:transfer=COMBREL-bound
COMPARED := default COMBREL:transfer=COMBREL random:transfer=random oracle:transfer=oracle
MISLEADING := noise-small noise noise-large shuffled mirrored wrong-goal wrong-rewards scaled-rewards few other-domain
RECORDED := uniform scripted random last-policy never-neutral noisy 3000 10000
ON_THE_ARM := default COMBREL:transfer=COMBREL random:transfer=random own-dynamics:transfer=own-dynamics
of = $(foreach name,$(1),from-$(name):transfer=COMBREL@$(name))
transfer: $(VENV)/.installed-demo
	$(TRANSFERRED) --output transfer/4d --tasks MountainCar4D --seeds 0-29 --variants $(COMPARED) $(PARTS) $(call of,$(MISLEADING))
	$(TRANSFERRED) --output transfer/recorded --tasks MountainCar4D --seeds 0-9 --variants $(call of,$(RECORDED))
	$(TRANSFERRED) --output transfer/6d --tasks MountainCar6D --seeds 0-9 --variants $(COMPARED)
	$(TRANSFERRED) --output transfer/cart-pole --tasks CartPole-long --seeds 0-19 --variants $(COMPARED)
	$(TRANSFERRED) --output transfer/arm --tasks ICubArm --seeds 0-19 --test mann-whitney --variants $(ON_THE_ARM) \
		$(call of,$(MISLEADING))

# A later call goes on with what is there.
suite: $(VENV)/.installed-demo
	$(BIN)/python -m sb3_combrel.experiments.suite.command --output suite_output $(SUITE_ARGS)

# ICUB_ARGS="--task arm --look primitives", for instance.
icub-video: $(VENV)/.installed-all gl
	$(BIN)/python -m sb3_combrel.experiments.film $(ICUB_ARGS)

test: $(VENV)/.installed-all gl
	$(BIN)/python -m sb3_combrel.experiments.warm_up
	$(BIN)/python -m pytest -n $(PYTEST_WORKERS) --dist worksteal --durations 25 -m "not long"

test-all: $(VENV)/.installed-all gl
	$(BIN)/python -m sb3_combrel.experiments.warm_up
	$(BIN)/python -m pytest -n $(PYTEST_WORKERS) --dist worksteal --durations 25

# In an environment, and with a cache of compiled code, of its own.
test-oldest: $(VENV)-oldest.txt
	NUMBA_CACHE_DIR="$(abspath $(VENV)-oldest/numba-cache)" \
		$(MAKE) test VENV=$(VENV)-oldest CONSTRAINTS=$(VENV)-oldest.txt PYTHON=$(OLDEST_PYTHON)

$(VENV)-oldest.txt: constraints.txt tests/constraints-oldest.txt
	{ grep -vE '^(llvmlite|numba|numpy)==' constraints.txt; cat tests/constraints-oldest.txt; } > $@

bench: $(VENV)/.installed-all
	$(BIN)/python -m sb3_combrel.experiments.bench
	$(BIN)/python -m pytest tests/benchmarks --benchmark-only

lint: $(VENV)/.installed-all
	$(BIN)/ruff check $(LINTED)
	$(BIN)/lint-imports

type: $(VENV)/.installed-all
	$(BIN)/mypy

format: $(VENV)/.installed-all
	$(BIN)/ruff check --select I $(LINTED) --fix
	$(BIN)/black $(LINTED)

check-codestyle: $(VENV)/.installed-all
	$(BIN)/ruff check --select I $(LINTED)
	$(BIN)/black --check $(LINTED)

commit-checks: format type lint

build: $(VENV)/.installed-all
	rm -rf build dist
	$(BIN)/python -m build
	$(BIN)/python -m twine check --strict dist/*

# Away from the clone, so that only what the wheel, and then the source distribution, has installed can be imported.
smoke_test = root="$$PWD" && cd "$$(mktemp -d)" && "$(abspath $(VENV)-smoke/bin/python)" "$$root/tests/helpers/smoke.py"

smoke: build
	$(call new_venv,$(VENV)-smoke)
	$(call pip,$(VENV)-smoke) "$$(echo dist/*.whl)[all]"
	$(call smoke_test)
	$(call pip,$(VENV)-smoke) --no-deps --force-reinstall dist/*.tar.gz
	$(call smoke_test)

# The source folder is that of the repository: see docs/conf.py.
doc: $(VENV)/.installed-all
	$(BIN)/python -m sphinx -W --keep-going -q -c docs -b html . docs/_build
	@echo "docs/_build/docs/index.html"

clean:
	rm -rf $(VENV) $(VENV)-oldest* $(VENV)-smoke build dist docs/_build *.egg-info

$(VENV)/.installed-demo: pyproject.toml sb3_combrel/version.txt $(CONSTRAINTS)
	$(call install,experiments)

$(VENV)/.installed-all: pyproject.toml sb3_combrel/version.txt $(CONSTRAINTS)
	$(call install,all$(comma)dev)
	@touch $(VENV)/.installed-demo

comma := ,

# uv does not read pip's settings: who has some gets pip.
OWN_INDEX := $(PIP_INDEX_URL)$(PIP_EXTRA_INDEX_URL)$(PIP_NO_INDEX)
UV ?= $(if $(OWN_INDEX)$(PIP_FIND_LINKS)$(PIP_CONFIG_FILE),,$(if $(shell command -v uv),uv))
pip = $(if $(UV),$(UV) pip install --python $(1)/bin/python --index-strategy unsafe-best-match,$\
	$(1)/bin/python -m pip --disable-pip-version-check install) -c $(CONSTRAINTS) $(torch_index)
new_venv = rm -rf $(1) && $(if $(UV),$(UV) venv --quiet --seed --python "$$(command -v $(PYTHON))" $(1),$(PYTHON) -m venv $(1))

# PyTorch for CPUs spares several GB of CUDA, which the default wheel for Linux brings: from its own index, if that answers.
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
WITHOUT_CUDA := $(if $(OWN_INDEX)$(UV_INDEX)$(UV_INDEX_URL)$(UV_EXTRA_INDEX_URL)$(UV_DEFAULT_INDEX),,$\
	$(if $(filter Linux,$(shell uname)),$(TORCH_INDEX)))
answers = timeout 4 $(PYTHON) -c 'import urllib.request as r; r.urlopen("$(WITHOUT_CUDA)/torch/", timeout=3)' 2>/dev/null
torch_index = $(if $(and $(PYTHON),$(WITHOUT_CUDA)),$(shell $(answers) && echo --extra-index-url $(WITHOUT_CUDA) || \
	echo "$(WITHOUT_CUDA) does not answer: going on without it" >&2))

# A first installation that was interrupted starts anew. The package is built with the setuptools of the environment, and
# dm_control goes in without labmaze where this has no wheel: only dm_control's locomotion tasks use it.
define install
@$(if $(PYTHON),,echo "Python 3.11, 3.12 or 3.13 is needed, and none was found. Install one, or name it: make PYTHON=/path/to/python" >&2; exit 1)
@$(PYTHON) -c '$(SUPPORTED)' || { echo "$(PYTHON) is $$($(PYTHON) --version 2>&1 | head -n 1); Python 3.11, 3.12 or 3.13 is needed: make PYTHON=/path/to/python" >&2; exit 1; }
@[ ! -e $(VENV)/.unfinished ] && $(BIN)/python -m pip --version >/dev/null 2>&1 || { $(call new_venv,$(VENV)) && touch $(VENV)/.unfinished; }
@install="$(call pip,$(VENV))" && $$install setuptools && $$install --no-build-isolation -e ".[$(1)]" && \
	{ $(BIN)/python -c 'import importlib.util as u; exit(u.find_spec("dm_control") is None)' || \
		$$install --no-deps dm_control; } || { echo "$$INSTALLATION_FAILED" >&2; exit 1; }
@rm -f $(VENV)/.unfinished && touch $@
endef

define INSTALLATION_FAILED

The installation failed, see above. It needs Python 3.11 to 3.13 and a package index that answers: pypi.org, or one of your own
by PIP_INDEX_URL=https://... (make UV= takes pip, with its settings, where there is uv). When this is mended, call make again.
endef
export INSTALLATION_FAILED

# Tests that draw need OpenGL; where it cannot be installed here they say what is missing.
gl:
	@if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && ! ldconfig -p | grep -q libEGL_mesa; then \
		export DEBIAN_FRONTEND=noninteractive; apt-get update -qq && apt-get install -y -qq libegl1 libgl1-mesa-dri || \
		echo "OpenGL could not be installed: tests that draw will fail, all others run" >&2; fi
