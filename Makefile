# Each target first sets up what it needs in .venv, with the sourced ROS 2 or with wheels; see tools/setup_venv.sh.
# Small matrices: a second thread of the linear algebra only gets in the way.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1

PYTHON := .venv/bin/python
SET_UP := tools/setup_venv.sh
STRESS_COUNT ?= 4
STRESS_JAWS ?= bench umi ssg48_fin_ray_1 xlerobot
DESCRIBED := setup.py setup.cfg pyproject.toml $(SET_UP)
ROS := $(if $(AMENT_PREFIX_PATH),ament,plain)

.PHONY: demo test lint bench figures stress docs pages build dist clean

demo: .venv/.$(ROS)-run
	$(PYTHON) -m finforce_eval.cli.main demo --report report

# What fails among others, beside real nodes in real time, has one more try alone.
test: .venv/.$(ROS)-test
	$(PYTHON) -m pytest -n auto --dist worksteal || $(PYTHON) -m pytest --last-failed --last-failed-no-failures none

lint: .venv/.$(ROS)-lint
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	.venv/bin/lint-imports
	.venv/bin/check-jsonschema --builtin-schema vendor.github-workflows .github/workflows/*.yml
	.venv/bin/hadolint --failure-threshold warning Dockerfile

bench: .venv/.$(ROS)-run
	$(PYTHON) -m finforce_eval.cli.main bench --json report/bench.json

# Every table of README and docs/ at this commit, part by part; a stopped run goes on. ARGS: parts, --recordings, --network.
figures: .venv/.$(ROS)-run
	$(PYTHON) -m tools.measure_pages $(ARGS)

# Every finger with the fixed seed and with one that is drawn anew and printed, two at a time.
stress: .venv/.$(ROS)-run
	@for jaw in $(STRESS_JAWS); do echo "0 $$jaw new $$jaw"; done | xargs -n 2 -P 2 sh -c '$(PYTHON) \
	  -m finforce_eval.cli.main stress --seed "$$0" --jaw "$$1" --count $(STRESS_COUNT)'

docs: .venv/.$(ROS)-docs
	NO_MKDOCS_2_WARNING=1 $(PYTHON) -m mkdocs build --strict

# Every command and program of README and docs that needs nothing but this machine.
pages: .venv/.$(ROS)-test
	$(PYTHON) test/core/page_trials.py

build: .venv/.$(ROS)-build
	$(PYTHON) -m colcon build --event-handlers console_cohesion+

# Wheel and sdist in dist/, tried in an empty environment without this checkout.
dist: .venv/.$(ROS)-dist
	rm -rf dist && $(PYTHON) -m build && $(PYTHON) -m twine check --strict dist/*
	tools/check_dist.sh $(PYTHON) dist/*.whl

.venv/.$(ROS)-%: $(DESCRIBED)
	$(SET_UP) $* $@

clean:
	rm -rf .venv build dist install log report site *.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -prune -exec rm -rf {} +
