# Two commands are all that a fresh machine with Python 3.11+ and make needs: `make demo` and `make test`.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed
PAPERS := .venv/.papers

# two processes more than cores, for many tests wait for processes of their own
TESTS := $(BIN)/python -m pytest -q --numprocesses $$(( $$(getconf _NPROCESSORS_ONLN) + 2 )) --dist loadfile
export PYTHONDONTWRITEBYTECODE :=  # what was parsed once is kept: tests start hundreds of processes

.PHONY: setup demo test test-all test-shuffled check package docs lint types faults faults-quick cluster-faults soak bench tune proto lock clean analytics-bench spark-test usability figures roads-bench page-bench ahead-bench browser-test batch-bench image kube country-bench

setup: $(STAMP)  ## make .venv and install everything, pinned

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[analytics,certs,demo,dev,iceberg,inputs,metrics,objects,page]'
	$(BIN)/python -m deploy.precompile
	touch $@

$(PAPERS): $(STAMP)
	$(BIN)/python -m deploy.precompile papers
	touch $@

demo: setup  ## router, fleet service and simulated vehicles; ends with the map beside the truth
	$(BIN)/python -m deploy.demo $(ARGS)

test: $(PAPERS)  ## the tests that take seconds; says what the slowest cost
	$(TESTS) --durations 10 -m 'not long and not campaign'

test-all: $(PAPERS)  ## these, and the campaigns in their quick form
	$(TESTS) --durations 10

test-shuffled: $(PAPERS)  ## all ten times in an order drawn anew: none may lean on another
	for round in 1 2 3 4 5 6 7 8 9 10; do $(TESTS) --random-order || exit 1; done

browser-test: setup  ## pages in the system's Chromium, and axe-core's scan of them; pictures in .page
	$(BIN)/python -m tests.npm axe-core
	$(BIN)/python -m pytest -q -rs tests/fleet_service/page tests/fleet_service/analytics/test_page.py

docs: setup  ## the documentation site, .docs/index.html; a warning is an error
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[docs]'
	$(BIN)/python -m sphinx -W --keep-going -q -c deploy/docs . .docs
	cp deploy/docs/landing.html .docs/index.html

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: setup
	$(BIN)/mypy

check: lint types test-all package faults-quick  ## what CI runs

package: setup  ## wheel and sdist, installed in a fresh environment outside the repository and used there
	$(BIN)/python -m tests.packaging

faults: setup  ## the fault campaigns, hours; writes .faults/figures.json
	$(BIN)/python -m tests.faults

faults-quick: setup  ## the same mechanisms in three minutes
	$(BIN)/python -m tests.faults --quick

roads-bench: setup  ## how often cells are joined to the right link, against SUMO's traffic; writes .roads/figures.json
	$(BIN)/python -m tests.benchmarks.roads

page-bench: setup  ## the live page measured, beside MapLibre in the same browser, and what leaves the house; .page/figures.json
	$(BIN)/python -m tests.npm axe-core maplibre-gl
	$(BIN)/python -m tests.benchmarks.page

ahead-bench: setup  ## cars that listen: warned in time, cost, delay, the map as a prior, towns that listen; .evaluation
	$(BIN)/edge-agent evaluate --only ahead --out .evaluation/ahead; first=$$?; \
	$(BIN)/python -m deploy.listening --out .evaluation/listening && exit $$first

usability: setup  ## the first hour of a new user as figures; wants chromium and unshare; writes .usability/figures.json
	$(BIN)/python -m tests.usability

figures: setup  ## keep what the campaigns' last runs measured in deploy/figures, and write the READMEs' numbers anew
	$(BIN)/python -m tests.usability.kept

image: setup  ## the steps of deploy/Dockerfile as a script, and a service of what they leave
	$(BIN)/python -m tests.image

kube: setup  ## manifests for Kubernetes: validated, and their pods' commands started; wants kubectl; .kube/figures.json
	$(BIN)/python -m tests.deploy.kubernetes

cluster-faults: setup  ## services that follow each other, a hundred times; writes .faults/cluster/figures.json
	$(BIN)/python -m tests.faults.cluster

soak: setup  ## half an hour of steady load: does anything grow?
	$(BIN)/python -m tests.faults.soak

bench: setup  ## cost of each part, side by side; writes .bench/figures.json
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[bench]'
	$(BIN)/python -m tests.benchmarks

batch-bench: setup  ## Iceberg tables beside the archive, Spark beside this machine; wants a Java; writes .batch/figures.json
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[spark]'
	$(BIN)/python -m tests.benchmarks.batch

country-bench: setup  ## SUMO's traffic for 300 of our vehicles, then 100 000 for ten minutes; writes .country/figures.json
	$(BIN)/python -m tests.benchmarks.country

analytics-bench: setup  ## archive and analytics on ten million rows, Spark beside; writes .analytics/figures.json
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[spark]'
	$(BIN)/python -m tests.benchmarks.analytics

spark-test: setup  ## Spark beside DuckDB and beside this machine; installs it, wants a Java
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[spark]'
	$(BIN)/python -m pytest -q -m long tests/fleet_service/analytics/test_spark.py tests/fleet_service/analytics/test_spark_rebuild.py tests/edge_agent/app/test_spark_replay.py

tune: setup  ## the ant colony over the memberships; writes the shipped file anew
	$(BIN)/edge-agent tune --out edge_agent/app/tuned/aco-fckf.json

proto: setup  ## generate the message modules from the .proto files
	$(BIN)/python -m grpc_tools.protoc -I schemas/proto --python_out=schemas/proto --pyi_out=schemas/proto gripmap.proto
	cd edge_agent/inputs/live/kuksa && $(CURDIR)/$(BIN)/python -m grpc_tools.protoc -I . --python_out=. --pyi_out=. broker.proto

lock: setup  ## write the installed versions to constraints.txt
	$(BIN)/python -m pip freeze --exclude-editable --exclude gripmap > constraints.txt

clean:
	rm -rf .venv .demo .docs dist .bench .analytics .evaluation .faults .usability .roads .page .batch .country build *.egg-info
