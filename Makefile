# Two commands for a newcomer: `make demo` flies, `make test` checks. Both are safe to repeat.
PYTHON ?= python3
VENV := .venv
STAMP := $(VENV)/.installed
COMPANION := $(VENV)/bin/companion

.PHONY: demo test lint slow bench clean

demo: $(STAMP)
	$(COMPANION) fly missions/first_flight.yaml --world demo --out flights/demo

# What needs no quiet machine runs twice as fast in two processes; what flies in real time runs alone.
test: $(STAMP)
	$(VENV)/bin/python -m pytest tests/flights tests/unit tests/structure -n 2 --dist loadfile -p no:benchmark
	$(VENV)/bin/python -m pytest tests/live tests/bench

lint: $(STAMP)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/lint-imports

slow: $(STAMP)
	$(VENV)/bin/python -m pytest -m slow

bench: $(STAMP)
	$(VENV)/bin/python -m pytest tests/bench -m "slow or not slow" --benchmark-only

# MAVProxy is a client in tests, without the second OpenCV and the VTK that MAVProxy's maps want.
# The stamp hangs on the files that say what to install, so a change there installs again.
$(STAMP): pyproject.toml constraints.txt
	@echo "Setting up $(VENV): about 45 s and 1.5 GB on a good line, once."
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --no-deps MAVProxy
	@touch $(STAMP)

clean:
	rm -rf $(VENV) build flights *.egg-info
