# Every target sets up what it needs: git, python3 with pip and venv, and make are enough.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
ARGS ?=

export OMP_NUM_THREADS ?= 1

# Tests start many processes: without bytecode, each of them would compile the package again.
test test-all test-rest: export PYTHONDONTWRITEBYTECODE =

.PHONY: reproduce test test-all test-rest lint types examples gallery benchmarks comparison choice certificates docs release-check minimal-versions clean

# One stamp for each set of extras, renewed when the project's requirements change.
$(VENV)/.%: pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --editable ".[$*]"
	touch $@

reproduce: $(VENV)/.solvers
	$(BIN)/qpmhe reproduce $(ARGS)

# Some cases of every test that is not slow, all cases, and what the first leaves out.
test: $(VENV)/.test
	$(BIN)/python -m pytest --numprocesses auto --dist worksteal $(ARGS)

test-all: $(VENV)/.test
	$(BIN)/python -m pytest --numprocesses auto --dist worksteal --all $(ARGS)

test-rest: $(VENV)/.test
	$(BIN)/python -m pytest --numprocesses auto --dist worksteal --rest $(ARGS)

# Style, and which room may import which.
lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/lint-imports --no-cache

types: $(VENV)/.dev
	$(BIN)/mypy

examples: $(VENV)/.test
	$(BIN)/python examples/quickstart.py
	$(BIN)/python examples/paper_figure.py --out results
	$(BIN)/python examples/outliers.py --seeds 4 --out results
	$(BIN)/python -m examples.gallery.reactors --quick --out results/gallery
	$(BIN)/python -m examples.gallery.weak_excitation --quick --out results/gallery
	$(BIN)/python -m examples.gallery.lorenz96 --quick --out results/gallery
	$(BIN)/python -m examples.gallery.stiff_and_algebraic --quick --out results/gallery
	$(BIN)/python examples/benchmarks/compare_peers.py --quick --problem reactor --out results
	$(BIN)/python examples/benchmarks/constrained.py --steps 60 --out results
	$(BIN)/python examples/benchmarks/batch.py --members 200 --steps 40 --out results
	$(BIN)/python examples/benchmarks/backends.py --quick --out results
	$(BIN)/python examples/closed_loop.py --steps 60 --seeds 1 --out results
	$(BIN)/python examples/learnt_noise/with_jax.py --steps 4 --records 1 --tests 2
	$(BIN)/qpmhe compare --seeds 2 --steps 40 --solver-iterations 2,none --store results/quick.sqlite --out results/compare

# The problems of docs/gallery. DATA holds a folder for each data set; a problem without its own says where to get it.
gallery: DATA ?= data
gallery: $(VENV)/.test
	$(BIN)/python -m examples.gallery.reactors --out results/gallery
	$(BIN)/python -m examples.gallery.weak_excitation --out results/gallery
	$(BIN)/python -m examples.gallery.lorenz96 --out results/gallery
	$(BIN)/python -m examples.gallery.stiff_and_algebraic --out results/gallery
	$(BIN)/python -m examples.gallery.indoor_uwb --data "$(DATA)/indoor_uwb" --out results/gallery
	$(BIN)/python -m examples.gallery.outdoor_uwb --data "$(DATA)/uwb_outdoor" --out results/gallery
	$(BIN)/python -m examples.gallery.smartloc --data "$(DATA)/smartloc_berlin" --out results/gallery
	$(BIN)/python -m examples.gallery.battery --data "$(DATA)/samsung_30t" --out results/gallery

# All benchmarks, beside all that PyPI has: an hour, most of it compiling; QUICK=--quick for minutes.
benchmarks: $(VENV)/.test
	$(BIN)/pip install --quiet --disable-pip-version-check -r examples/benchmarks/requirements.txt
	$(BIN)/python examples/benchmarks/compare_peers.py $(QUICK) --out results/benchmarks
	$(BIN)/python examples/benchmarks/scaling.py $(QUICK) --out results/benchmarks
	$(BIN)/python examples/benchmarks/large.py $(QUICK) --out results/benchmarks
	$(BIN)/python examples/benchmarks/nonlinear.py
	$(BIN)/python examples/benchmarks/constrained.py --out results/benchmarks
	$(BIN)/python examples/benchmarks/algebraic.py --out results/benchmarks
	$(BIN)/python examples/benchmarks/batch.py --out results/benchmarks
	$(BIN)/python examples/benchmarks/backends.py $(QUICK) --out results/benchmarks
	$(BIN)/python examples/benchmarks/latency.py --out results/benchmarks

# The page docs/comparison.md, of a run of the default study: ten minutes on two cores.
comparison: $(VENV)/.test
	$(BIN)/qpmhe compare --store results/comparison.sqlite --out results/comparison
	$(BIN)/qpmhe compare --store results/filters.sqlite --out results/filters --backend banded --qps 0,2 \
		--solver-iterations none --estimator EKF=ekf --estimator UKF=ukf --estimator EnKF=enkf \
		--estimator particles
	$(BIN)/python examples/studies/comparison_page.py results/comparison.sqlite results/comparison \
		results/filters.sqlite

# The figures of docs/how-to-choose.md: about ten minutes on two cores; after a new comparison, too.
choice: $(VENV)/.test
	$(BIN)/python examples/studies/choice_page.py

# The page docs/certified-systems.md and the picture of docs/how-to/certify.md: some minutes on two cores.
certificates: $(VENV)/.test
	$(BIN)/python examples/studies/certificates_page.py

docs: $(VENV)/.docs
	$(BIN)/mkdocs build --strict

# What a release would carry: the archives hold what they must, and nothing else.
release-check: $(VENV)/.dev
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	$(BIN)/twine check --strict dist/*
	$(BIN)/python tests/check_dist.py dist

# The lowest versions that pyproject.toml promises, in an environment of their own.
minimal-versions:
	rm -rf $(VENV)/minimal
	$(PYTHON) -m venv $(VENV)/minimal
	$(VENV)/minimal/bin/pip install --quiet --disable-pip-version-check -c tests/minimal-versions.txt ".[all]" pytest hypothesis
	cd tests && $(abspath $(VENV))/minimal/bin/python smoke.py
	$(VENV)/minimal/bin/python -m pytest -q -W default::DeprecationWarning tests/oracles/test_kalman.py tests/oracles/test_dense.py tests/test_package.py

clean:
	rm -rf $(VENV) dist results site .mypy_cache .pytest_cache .ruff_cache .hypothesis
