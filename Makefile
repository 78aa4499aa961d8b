# Every run's environment, in one place.
# One thread per rank: cells are shared out over ranks, and BLAS only sees tiny matrices.
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1
# Containers and CI are root, which Open MPI refuses, and have no network, about which it complains.
export OMPI_ALLOW_RUN_AS_ROOT := 1
export OMPI_ALLOW_RUN_AS_ROOT_CONFIRM := 1
export OMPI_MCA_btl := ^tcp
# Ranks that wait leave the core to those that work: tests run more ranks than there are cores.
export OMPI_MCA_mpi_yield_when_idle := 1

PYTHON := .venv/bin/python
# --oversubscribe: also more ranks than cores; --bind-to none: several runs may share the machine.
MPIRUN := mpirun --oversubscribe --bind-to none
PYTEST := $(PYTHON) -m pytest
# Ranks share one work tree, hence one pytest cache at most; a deadlock shows where it is.
MPI_PYTEST := $(PYTEST) --color=no -p no:cacheprovider -o faulthandler_timeout=240
# nproc obeys OMP_NUM_THREADS, which is 1 here.
RANKS := $(shell n=$$(env -u OMP_NUM_THREADS nproc); echo $$((n < 2 ? n : 2)))

.PHONY: help setup demo charts test verify test-debian13 docs lint clean

help: ## this list
	@awk -F ':.*## ' '/^[a-z0-9-]+:.*## / { printf "make %-14s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: ## install what is missing (Debian packages, .venv)
	@tools/setup.sh

demo: setup ## an impact, computed and drawn (results/impact)
	$(MPIRUN) -n $(RANKS) .venv/bin/complexbody run demos/impact.py --out results/impact
	@echo; echo "Pictures, and fields for ParaView:"
	@find results/impact -name '*.png' -o -name '*.xdmf' -o -name '*.bp' | sort | sed 's/^/  /'

# Minutes each. A chart that was interrupted goes on: remove docs/charts/*/chart.json to begin anew.
# On graded meshes peers get more time per point first, else hardly any would be on the finest.
CHART = $(PYTHON) -m complexbody chart benchmarks/scenes/$(1).py --out docs/charts/$(1)
PEERS = --methods assembly,matrix,petsc-rk4,petsc-alpha2,petsc-cn,newmark \
	--steps 2 --repeats 1 --budget
NOTCH = --meshes refine=0.3,0.5,0.8
PLATE = --meshes refine=0.3,0.45,0.6

charts: setup ## speed against accuracy on four scenes (docs/charts), serially, an hour
	$(call CHART,bar) --meshes cells=100,200,400,800 --steps 5 --budget 3
	$(call CHART,phason) --meshes cells=20,40,80 --steps 5 --budget 3
	$(call CHART,notch) $(NOTCH) $(PEERS) 60
	$(call CHART,notch) $(NOTCH) --steps 5 --budget 10
	$(call CHART,plate) $(PLATE) $(PEERS) 100
	$(call CHART,plate) $(PLATE) --steps 4 --budget 15

# One half of the serial tests; the other takes what is left, in about the same time.
HALF := $(wildcard tests/test_[a-q]*.py tests/verification/test_windows*.py) tests/forms tests/kernels

# On a new machine compiling takes longer than the few steps of a test: it is told to hurry.
test: export COMPLEXBODY_OPTIMISATION := -O1
# All are run, whichever fails: serially in two halves at once; on 2 ranks what is about ranks and
# a 16th of the rest, on 3 half of that (make verify: all of it).
test: setup ## all but the slow tests: serially, on 2 and on 3 ranks
	@status=0; mkdir -p build/test-tmp/half; set -x; \
	PYTEST_DEBUG_TEMPROOT=build/test-tmp/half $(PYTEST) -p no:cacheprovider --color=no \
	    -m "not slow" $(HALF) >build/half.log 2>&1 & half=$$!; \
	$(PYTEST) -m "not slow" $(HALF:%=--ignore=%) || status=1; \
	wait $$half || status=1; cat build/half.log; \
	timeout -k 10 900 $(MPIRUN) -n 2 $(MPI_PYTEST) -m "not serial and not slow" --sample 16 \
	    || status=1; \
	timeout -k 10 900 $(MPIRUN) -n 3 $(MPI_PYTEST) -m "not serial and not slow" --sample 32 --about 2 \
	    || status=1; \
	exit $$status

verify: setup ## every test, slow ones too: serially, on 2 and on 3 ranks
	@status=0; set -x; \
	$(PYTEST) || status=1; \
	timeout -k 10 7200 $(MPIRUN) -n 2 $(MPI_PYTEST) -m "not serial" || status=1; \
	timeout -k 10 7200 $(MPIRUN) -n 3 $(MPI_PYTEST) -m "not serial and not slow" || status=1; \
	exit $$status

test-debian13: ## make test in a Debian 13 root (as root; ARGS="..." runs that instead)
	@tools/test-debian13.sh $(if $(ARGS),"$(ARGS)")

docs: setup ## the documentation as HTML (build/docs), links and docstrings checked
	@test -x .venv/bin/sphinx-build || \
	    $(PYTHON) -m pip install -q -c .venv/constraints.txt -e '.[docs]'
	.venv/bin/sphinx-build -W --keep-going -q -b html docs build/docs
	@echo build/docs/index.html

lint: setup ## ruff and mypy
	@test -x .venv/bin/mypy -a -x .venv/bin/ruff || \
	    $(PYTHON) -m pip install -q -c .venv/constraints.txt -e '.[dev]'
	.venv/bin/ruff check .
	.venv/bin/mypy

clean: ## remove results and what the build made; keep .venv
	rm -rf build results dist *.egg-info .pytest_cache .hypothesis .mypy_cache .ruff_cache
	find . -path ./.venv -prune -o -name __pycache__ -type d -exec rm -rf {} +
