# zestjax: `make test` and `make demo` need only Python 3.11-3.13 and make the virtual environment themselves.

VENV ?= .venv
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11 python; do \
	$$p -c 'import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' >/dev/null 2>&1 \
	&& echo $$p && break; done)
RUN = $(VENV)/bin/python
# Two test workers on two cores: one XLA thread each, or they fight.
WORKERS ?= 2
# Compiling is most of the suite: tests/conftest.py makes it cheap. `make test-slow` compiles as users do.
FAST = ZESTJAX_FAST_COMPILING=1
TEST_ENV = PJRT_NPROC=1 OMP_NUM_THREADS=1 MPLBACKEND=Agg
PYTEST = $(TEST_ENV) $(RUN) -m pytest -q -n $(WORKERS) --dist loadfile

.PHONY: test lint demo bench fuzz kills slurm mutations stability precision study notebooks test-slow test-lowest test-newest clean

$(VENV)/installed: pyproject.toml
	@test -n "$(PYTHON)" || { echo "error: no Python 3.11-3.13 with venv found; pass PYTHON=/path/to/python" >&2; exit 2; }
	rm -rf $(VENV)
	$(PYTHON) -m venv $(VENV)
	$(RUN) -m pip install -q --upgrade pip
	$(RUN) -m pip install -q $(CONSTRAINTS) -e '.[dev]'
	touch $@

test: lint
	$(FAST) $(PYTEST) -m "not slow"

lint: $(VENV)/installed
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .
	$(RUN) -m pyright --pythonpath $(RUN)

demo: $(VENV)/installed
	$(VENV)/bin/zestjax demo --out runs/demo

bench: $(VENV)/installed
	$(RUN) experiments/bench.py --out runs/bench

# 3,000 damaged files of every format: each loads, or is refused by one line that names it.
fuzz: $(VENV)/installed
	$(TEST_ENV) $(RUN) experiments/fuzz.py

# Undo one guard of the numeric core at a time: some test must fail.
mutations: $(VENV)/installed
	$(TEST_ENV) $(RUN) experiments/mutations.py

# 2,000 steps of `tiny` over nasty scenes, with either set of losses and with half-precision networks.
stability: $(VENV)/installed
	$(RUN) experiments/stability.py --out runs/stability/frames
	$(RUN) experiments/stability.py --out runs/stability/paper --losses paper
	$(RUN) experiments/stability.py --out runs/stability/half --precision bfloat16

# What float32, bfloat16 networks and float64 cost and give up, on the same weights.
precision: $(VENV)/installed
	$(RUN) experiments/precision.py --out runs/precision

# Kill trainings 100 times, inside their writes and at random, and compare what they resume to with an unbroken run.
kills: $(VENV)/installed
	$(RUN) experiments/kills.py --out runs/kills

# A cross-validation on a real SLURM of one node, installed from Debian's packages: as root, in a container.
slurm: $(VENV)/installed
	$(RUN) -m pip install -q -e '.[slurm]'
	$(TEST_ENV) $(RUN) experiments/slurm.py --out runs/slurm

# The paper's two tables on zest-bench: every system trained for ten minutes on the same clips (three hours on two cores).
study: $(VENV)/installed
	$(RUN) experiments/study.py --out runs/study

# Run the notebooks and write experiments/notebooks/rendered/.
notebooks: $(VENV)/installed
	$(RUN) -m pip install -q -e '.[notebooks]'
	XLA_FLAGS=--xla_backend_optimization_level=1 $(RUN) experiments/notebooks/build.py

test-slow: $(VENV)/installed
	$(PYTEST) -m slow

# The fast suite at the declared lower bounds, and at the newest versions the bounds admit.
test-lowest:
	mkdir -p build && $(PYTHON) experiments/lower_bounds.py pyproject.toml > build/lowest.txt
	$(MAKE) VENV=.venv-lowest CONSTRAINTS="-c build/lowest.txt" .venv-lowest/installed
	$(MAKE) VENV=.venv-lowest fast

test-newest:
	rm -rf .venv-newest
	$(MAKE) VENV=.venv-newest CONSTRAINTS="--upgrade" .venv-newest/installed
	$(MAKE) VENV=.venv-newest fast

.PHONY: fast
fast: $(VENV)/installed
	$(FAST) $(PYTEST) -m "not slow"

clean:
	rm -rf .venv .venv-lowest .venv-newest build dist runs .pytest_cache .ruff_cache .hypothesis
