# Two commands are all that a fresh machine with Python 3.11+ and make needs: `make demo` and `make test`.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed

.PHONY: setup demo test check lint types bench tune proto lock clean

setup: $(STAMP)  ## make .venv and install everything, pinned

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[demo,dev]'
	touch $@

demo: setup  ## router, fleet service and simulated vehicles; ends with the map beside the truth
	$(BIN)/python -m deploy.demo

test: setup  ## the tests that take seconds
	$(BIN)/python -m pytest -q

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: setup
	$(BIN)/mypy

check: lint types test  ## what CI runs

bench: setup  ## cost of each part, side by side; writes .bench/figures.json
	$(BIN)/python -m tests.benchmarks

tune: setup  ## the ant colony over the memberships; writes the shipped file anew
	$(BIN)/edge-agent tune --out edge_agent/tuning/tuned/aco-fckf.json

proto: setup  ## generate the message module from the .proto
	$(BIN)/python -m grpc_tools.protoc -I schemas/proto --python_out=schemas/proto --pyi_out=schemas/proto gripmap.proto

lock: setup  ## write the installed versions to constraints.txt
	$(BIN)/python -m pip freeze --exclude-editable --exclude gripmap > constraints.txt

clean:
	rm -rf .venv .demo .bench build *.egg-info
