# Each target sets up what it needs in .venv first; see tools/setup_venv.sh.
PYTHON := .venv/bin/python
SET_UP := tools/setup_venv.sh
DESCRIBED := setup.py setup.cfg pyproject.toml $(SET_UP)

.PHONY: demo test lint bench build clean

demo: .venv/.run
	$(PYTHON) -m finforce_eval.cli demo

test: .venv/.test
	$(PYTHON) -m pytest

lint: .venv/.lint
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .

bench: .venv/.run
	$(PYTHON) -m finforce_eval.cli bench --json report/bench.json

build: .venv/.build
	$(PYTHON) -m colcon build --event-handlers console_cohesion+

.venv/.%: $(DESCRIBED)
	$(SET_UP) $*

clean:
	rm -rf .venv build install log report *.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -prune -exec rm -rf {} +
