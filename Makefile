# A fresh machine with Python 3.11+ and make needs only two commands: `make demo` and `make test`.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed
PAPERS := .venv/.papers
LIGHT := .venv/.light
ONLY ?=

# Two processes more than cores, because many tests wait for processes that they started.
PYTEST := -m pytest -q --numprocesses $$(( $$(getconf _NPROCESSORS_ONLN) + 2 )) --dist loadfile
TESTS := $(BIN)/python $(PYTEST)
export PYTHONDONTWRITEBYTECODE :=  # keep byte code: tests start hundreds of processes

# Main targets have a comment "##", campaigns "#=", everything else "#-"; `make help` and `make campaigns` print them.
.DEFAULT_GOAL := help
.PHONY: help campaigns setup demo test test-all coverage test-shuffled check package docs lint types results figures \
  release faults faults-quick cluster-faults soak bench tune proto lock audit fuzz clean analytics-bench spark-test usability \
  sensitivity roads-bench page-bench ahead-bench iov-bench browser-test batch-bench image kube country-bench

help:  #- print the main targets
	@grep -E '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | awk -F '\t' '{printf "%-18s%s\n", $$1, $$2}'
	@echo; echo "make demo runs the demonstration; make campaigns lists the long measurements"

campaigns:  #- print the campaigns
	@grep -E '^[a-z-]+:.*#= ' $(MAKEFILE_LIST) | sed -E 's/:[^#]*#= /\t/' | awk -F '\t' '{printf "%-18s%s\n", $$1, $$2}'
	@echo; echo "Each writes figures.json; make figures keeps them in deploy/figures and writes deploy/docs/results.md."

setup: $(STAMP)  ## install everything into .venv, pinned

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[analytics,certs,demo,dev,iceberg,inputs,mcap,metrics,objects,page,webhook]'
	$(BIN)/python -m deploy.precompile
	touch $@

$(PAPERS): $(STAMP)
	$(BIN)/python -m deploy.precompile papers
	touch $@

demo: $(LIGHT)  ## router, service, page and simulated cars; prints the address of the live map
	$(BIN)/gripmap demo $(ARGS)

# Packages for the demo only, without those for developers.
$(LIGHT): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[demo,page]'
	$(BIN)/python -m deploy.precompile
	touch $@

test: $(PAPERS)  ## tests that take seconds
	$(TESTS) --durations 10 -m 'not long and not campaign'

test-all: $(PAPERS)  #- all tests, and the campaigns in their quick form
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[cits]' \
	  || echo "no compiler for python-qpid-proton: the tests of C-ITS are skipped" >&2
	$(TESTS) --durations 10 -rs

coverage: $(PAPERS)  #= branch coverage of each package by the tests that take seconds, lab/ apart; half an hour
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[cits]' \
	  || echo "no compiler for python-qpid-proton: the tests of C-ITS are left out" >&2
	mkdir -p .coverage
	$(BIN)/python -m coverage erase
	find tests -name 'test_*.py' | sort | xargs -P $$(getconf _NPROCESSORS_ONLN) -n 12 \
	  $(BIN)/python -m coverage run -m pytest -q -m 'not long and not campaign' --continue-on-collection-errors \
	  || echo 'coverage: some tests failed; tracing makes them slow'
	$(BIN)/python -m coverage combine --quiet
	rm -f .coverage/data.*
	$(BIN)/python -m tests.branch_coverage .coverage/data

test-shuffled: $(PAPERS)  #- all tests ten times in random order
	for round in 1 2 3 4 5 6 7 8 9 10; do $(TESTS) --random-order || exit 1; done

browser-test: setup  #= pages in Chromium, with accessibility checks
	$(BIN)/python -m tests.npm axe-core
	$(BIN)/python -m pytest -q -rs tests/fleet_service/page tests/fleet_service/analytics/test_page.py

docs: setup  ## build the documentation site in .docs; warnings are errors
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[docs]'
	$(BIN)/python -m sphinx -W --keep-going -q -c deploy/docs . .docs
	cp deploy/docs/landing.html .docs/index.html

lint: setup  #- ruff, and figures of the structure
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m tests.structure

types: setup  #- mypy
	$(BIN)/mypy

check: lint types test-all package faults-quick  ## lint, types, all tests, package, quick faults: what CI runs

package: setup  #- wheels and sdist, installed and used in a fresh environment
	$(BIN)/python -m tests.packaging

faults: setup  #= fault campaigns, hours
	$(BIN)/python -m tests.faults

faults-quick: setup  #= the same mechanisms in three minutes
	$(BIN)/python -m tests.faults --quick

roads-bench: setup  #= road join against SUMO traffic
	$(BIN)/python -m tests.benchmarks.roads

page-bench: setup  #= the live page next to MapLibre in the same browser; needs Chromium and npm
	$(BIN)/python -m tests.npm axe-core maplibre-gl
	$(BIN)/python -m tests.benchmarks.page

ahead-bench: setup  #= warnings in the car, and the map as a prior
	$(BIN)/python -m tests.benchmarks.ahead; first=$$?; \
	$(BIN)/python -m tests.benchmarks.ahead.listening --out .evaluation/listening && exit $$first

iov-bench: setup  #= DENM, routes around ice, planner, Kuksa, MCAP, clients in C and TypeScript
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[cits]'
	$(BIN)/python -m tests.benchmarks.iov

usability: setup  #= the first hour of a new user; needs Chromium and unshare
	$(BIN)/python -m tests.usability

figures: setup  #- keep the figures of the last runs, and write the results page
	$(BIN)/python -m tests.results

results: setup  #- write the results page from the kept figures
	$(BIN)/python -m tests.results --pages-only

release: setup  #- VERSION=x.y.z: check the changelog, set the version, build sdist, wheels and SBOM in dist/
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[release]'
	$(BIN)/python -m tests.release $(VERSION)

image: setup  #= the steps of the Dockerfile, and a service of its result
	$(BIN)/python -m tests.image

kube: setup  #= Kubernetes manifests validated, their commands started; needs kubectl
	$(BIN)/python -m tests.deploy.kubernetes

cluster-faults: setup  #= a hundred failovers between services
	$(BIN)/python -m tests.faults.cluster

soak: setup  #= half an hour of steady load; memory and handles
	$(BIN)/python -m tests.faults.soak

bench: setup  ## measure the cost of each part; ONLY=fusion measures one
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[bench]'
	$(BIN)/python -m tests.benchmarks $(ONLY)

batch-bench: setup  #= Iceberg and Spark next to one machine; needs Java
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[spark]'
	$(BIN)/python -m tests.benchmarks.batch

country-bench: setup  #= a city and 100 000 vehicles
	$(BIN)/python -m tests.benchmarks.country

analytics-bench: setup  #= archive and questions on ten million rows
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[spark]'
	$(BIN)/python -m tests.benchmarks.analytics

spark-test: setup  #= Spark and DuckDB give the same answers; needs Java
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[spark]'
	$(BIN)/python -m pytest -q -m long tests/fleet_service/analytics/test_spark.py tests/fleet_service/analytics/test_spark_rebuild.py tests/edge_agent/app/test_spark_replay.py

tune: setup  #- search the memberships; writes the shipped file
	$(BIN)/edge-agent tune --out edge_agent/app/tuned/aco-fckf.json

sensitivity: setup  #= effect of every constant of the default filter; half an hour
	$(BIN)/python -m edge_agent.lab.tuning.sensitivity

proto: setup  #- generate the message modules
	$(BIN)/python -m grpc_tools.protoc -I schemas/proto --python_out=schemas/proto --pyi_out=schemas/proto gripmap.proto
	cd edge_agent/inputs/live/kuksa && $(CURDIR)/$(BIN)/python -m grpc_tools.protoc -I . --python_out=. --pyi_out=. broker.proto

lock: setup  #- write the installed versions and their hashes
	$(BIN)/python -m pip freeze --exclude-editable --exclude gripmap > constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	$(BIN)/uv pip compile --quiet --generate-hashes --no-deps --no-annotate --no-header --python-version 3.11.9 constraints.txt -o deploy/constraints-hashes.txt

audit: setup  #- look for known vulnerabilities of the pinned versions; needs a network
	$(BIN)/python -m pip install --quiet --disable-pip-version-check pip-audit
	$(BIN)/pip-audit --no-deps --disable-pip --require-hashes -r deploy/constraints-hashes.txt

fuzz: setup  #= coverage-guided fuzzing of parsers, ten minutes; FUZZ_S=SECONDS for each parser
	$(BIN)/python -m tests.fuzz --seconds $(or $(FUZZ_S),45)

clean:
	rm -rf deploy/docs/reference/generated .iov .venv .demo .docs dist .bench .analytics .evaluation .faults .usability .roads .page .batch .country build *.egg-info
