PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
CALIBRATE := rollout --calibrate --level 0.99 --episodes 100 --seed 5000
SLALOM := --constraints constraints/maze2d-umaze-slalom.yaml

# Threads that wait do not spin: several processes share the cores.
export OMP_WAIT_POLICY ?= PASSIVE
export GOMP_SPINCOUNT ?= 0

.PHONY: demo test lint pages docs benchmark oracle experts margins clean

demo: .venv/.ready  ## plan on the shipped model with every method, compare
	$(BIN)/cdiff plan --method diffuser $(SLALOM) --runs runs/demo --json >/dev/null
	$(BIN)/cdiff plan --method projected $(SLALOM) --runs runs/demo --json >/dev/null
	$(BIN)/cdiff plan --method primal-dual $(SLALOM) --runs runs/demo --json >/dev/null
	$(BIN)/cdiff plan --method alm $(SLALOM) --runs runs/demo
	$(BIN)/cdiff compare runs/demo

test: lint  ## lint, types, tests
	$(BIN)/python -m pytest -n 2 -q

lint: .venv/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

pages: .venv/.ready  ## the generated blocks of README.md and docs/: results, constraint kinds, commands, programs
	$(BIN)/python docs/generate.py

docs: .venv/.ready  ## the documentation site, into .site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict -f docs/site/mkdocs.yml

benchmark: .venv/.ready  ## timings, as ratios within one run
	$(BIN)/python tests/benchmarks/speed/constraint_share.py

oracle: .venv/.ready  ## methods against the true constrained law, exact scores; several minutes
	$(BIN)/python tests/benchmarks/studies/oracle.py

experts: .venv/.ready  ## search the gaits of models/*/expert.json anew; about 20 minutes
	$(BIN)/python -m cdiff_cli.tasks.mujoco.gait_search swimmer --seed 0 1
	$(BIN)/python -m cdiff_cli.tasks.mujoco.gait_search hopper --seed 0 5

margins: .venv/.ready  ## calibrate the margins of models/*/small.margins.yaml anew; an hour or more
	for c in hopper hopper-hard swimmer swimmer-hard; do for m in alm projected primal-dual safediffuser; do \
		$(BIN)/cdiff $(CALIBRATE) --task $${c%-hard} --constraints constraints/$$c.yaml --method $$m || exit 1; done; done
	for c in hopper swimmer; do for k in '--execute 2' '--execute 4' '--execute 8' '--warm 0.3'; do \
		$(BIN)/cdiff $(CALIBRATE) --task $$c $$k || exit 1; done; done

.venv/.ready: requirements.txt pyproject.toml
	test -d .venv || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install -q --disable-pip-version-check -r requirements.txt
	$(BIN)/python -m pip install -q --disable-pip-version-check --no-build-isolation --no-deps -e .
	touch $@

clean:
	rm -rf .venv .site .mypy_cache .ruff_cache .pytest_cache .hypothesis
