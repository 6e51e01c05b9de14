# ortho-pipeline: everything that a person or a CI machine runs.
#
#   make demo     set up, orthorectify the sample scene, say where the ortho and the report are
#   make test     set up, run the tests (under ten minutes on two cores)
#   make test-all the same with those marked slow
#   make real-data  fetch the real images of the tests marked `realdata` into out/real-data (51 MB from public
#                 repositories); they may be used for tests and are not part of this package
#   make faults   commands limited, killed, cut off: no broken or mixed outputs (N=400 write limits, 3/4 as many kills)
#   make check    formatting, lint, types (make lint), tests
#   make test-with  the tests with the oldest packages that pyproject.toml allows, or RESOLUTION=highest: the newest
#   make page-types  the types of the scripts of `ortho measure`, by TypeScript (npx fetches it)
#   make fuzz     read damaged files with every reader (N=100000 of each, READER=name for one, KEEP=folder for results)
#   make mutants  small deliberate errors, and which of them no test catches (COUNT=300 of them, drawn by SEED=1); a run
#                 that was stopped goes on where it was
#   make bench    speed and memory against gdalwarp, of adjustments, of many scenes: docs/performance.json (an hour)
#   make peers    the same jobs by GDAL, OTB, rasterio, orthority and AROSICS, where they can be had: time, memory, errors,
#                 and what they do with faults; the tables of docs/comparison.md (half an hour)
#   make packages build sdist and wheel, install and try both in clean environments (PYTHONS=python3.12=wheel, more)
#   make dist     build sdist and wheel in out/dist
#   make sbom     list the wheel and what it requires, as they were tested, in out/dist/sbom.cdx.json (CycloneDX)
#   make docs     do the tutorials and draw their pictures, then the documentation as a site in out/site, links checked,
#                 and manual pages in out/man
#   make images   draw all pictures again: README.md, docs/measure.md, docs/report.md, tutorials, notebooks (Chromium)
#   make constraints  pin the newest packages in tools/constraints.txt, with their hashes
#   make pin-image    pin the base image of the Dockerfile by its digest (needs docker)
#   make clean    remove .venv, caches and out/
#
# PYTHON=python3.12     the interpreter that .venv is made from (3.11 or newer)
# GDAL=auto             auto:   the system's GDAL; installed with apt where it is missing and we may; otherwise the wheel
#                       system: the system's GDAL or nothing
#                       wheel:  the PyPI package gdal-wheel, which brings a GDAL of its own (Python 3.12 or newer, no root)
# APT=auto              auto:   install missing system packages with apt-get, as root or with a sudo that asks no password;
#                               says first which and why
#                       no:     install none; say which command installs them

PYTHON ?= python3
GDAL ?= auto
APT ?= auto
VENV := .venv
CONSTRAINTS := tools/constraints.txt
BIN := $(VENV)/bin
STAMP := $(VENV)/.set-up
# One more than the processors of a small machine: tests wait for browsers and other processes.
WORKERS ?= 3
IMAGE ?= python:3.13-slim
N ?= 100000
READER ?=

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.ONESHELL:
.DEFAULT_GOAL := help
.PHONY: help setup demo test test-all test-with real-data faults mutants lint check dist sbom page-types fuzz bench peers packages docs images constraints pin-image clean

help:
	@sed -n '2,/^$$/s/^# \{0,1\}//p' Makefile

setup: $(STAMP)

$(STAMP): pyproject.toml Makefile tools/setup.sh $(CONSTRAINTS)
	@PYTHON="$(PYTHON)" GDAL="$(GDAL)" APT="$(APT)" VENV="$(VENV)" CONSTRAINTS="$(CONSTRAINTS)" bash tools/setup.sh
	touch $@

demo: setup
	@echo
	$(BIN)/ortho rectify sample_data/scene.tif --gcps sample_data/gcps.geojson \
	    --dem sample_data/dem.tif -o out/demo
	echo
	echo "Ortho:   $(CURDIR)/out/demo/scene_ortho.tif   (any GIS opens it)"
	echo "Report:  $(CURDIR)/out/demo/scene_report.html (any browser opens it)"

# Each worker has one processor: threads of BLAS would only wait for each other.
PYTEST = OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n $(WORKERS) --dist worksteal

test: setup
	@$(PYTEST) -m "not slow"

test-all: setup
	@$(PYTEST)

# Needs Python alone.
real-data:
	@$(PYTHON) tools/real_data.py

faults: N := $(if $(filter file,$(origin N)),400,$(N))
faults: setup
	@$(BIN)/python tests/attack/faults.py --limits $(N) --kills $$(( $(N) * 3 / 4 ))

SEED ?= 1
COUNT ?= 300
mutants: setup
	@$(BIN)/python tools/mutants.py --record
	$(BIN)/python tools/mutants.py --seed $(SEED) --count $(COUNT)
	@$(BIN)/python tools/mutants.py --record $(addprefix tests/,attack batch cli measure storage studies)
	$(BIN)/python tools/mutants.py --seed $(SEED) --count $(COUNT) --again --limit 240

# The packages of a resolution of uv, in an environment of their own.
RESOLUTION ?= lowest-direct
test-with: setup
	@$(BIN)/pip install --quiet --require-hashes -c tools/constraints.txt uv
	mkdir -p out
	$(BIN)/uv pip compile --quiet --universal --generate-hashes --upgrade --resolution $(RESOLUTION) --extra dev --extra wheel \
	    --python-version "$$($(BIN)/python -c 'import sys; print("%d.%d" % sys.version_info[:2])')" \
	    -o out/$(RESOLUTION).txt pyproject.toml tools/constraints.in
	$(MAKE) test VENV=out/venv-$(RESOLUTION) CONSTRAINTS=out/$(RESOLUTION).txt

lint: setup
	@$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

check: lint
	@$(PYTEST) -m "not slow"

dist: setup
	@strays=$$(git ls-files --others --exclude-standard 2>/dev/null || true)
	[ -z "$$strays" ] || { echo "Error: files that git does not know would be in the sdist: $$strays" >&2; exit 1; }
	rm -rf out/dist
	$(BIN)/python -m hatchling build --directory out/dist

# The list is of an environment that has only the wheel and its requirements.
SBOM_PIP = $(BIN)/python -m pip --disable-pip-version-check --python out/sbom/bin/python install --quiet
sbom: dist
	@rm -rf out/sbom out/cyclonedx
	$(BIN)/python -m venv --without-pip out/sbom
	$(BIN)/python tools/requirements.py | $(SBOM_PIP) --require-hashes -c $(CONSTRAINTS) -r /dev/stdin
	$(SBOM_PIP) --no-deps out/dist/*.whl
	$(BIN)/python -m venv out/cyclonedx
	out/cyclonedx/bin/pip install --quiet cyclonedx-bom==7.5.0
	out/cyclonedx/bin/cyclonedx-py environment --pyproject pyproject.toml --output-reproducible \
	    -o out/dist/sbom.cdx.json out/sbom/bin/python

page-types:
	@npx --yes -p typescript@5.9 tsc -p tests/measure/types

fuzz: setup
	@$(BIN)/python tests/attack/fuzz.py -n $(N) -j $(WORKERS) $(addprefix --reader ,$(READER)) $(addprefix --keep ,$(KEEP))

bench: setup
	@$(BIN)/python benchmarks/collect.py

# Each program of others in an environment of its own; one that cannot be installed is left out.
peers: setup
	@mkdir -p out/peers
	given=()
	for name in rasterio orthority arosics; do
	    if [ ! -x out/peers/$$name/bin/python ]; then $(PYTHON) -m venv out/peers/$$name; fi
	    packages=($$name)
	    if [ $$name = arosics ] && command -v gdal-config > /dev/null; then
	        # It needs the bindings of GDAL, whose newest release does not fit the system's library.
	        packages+=("gdal==$$(gdal-config --version)" "numpy<2")
	        out/peers/$$name/bin/python -m pip install --quiet "setuptools<72" wheel "numpy<2" &&
	            out/peers/$$name/bin/python -m pip install --quiet --no-build-isolation "$${packages[1]}" || true
	    fi
	    if out/peers/$$name/bin/python -m pip install --quiet "$${packages[@]}"; then given+=(--$$name out/peers/$$name/bin/python)
	    else echo "Skipped: $$name cannot be installed"; fi
	done
	$(BIN)/python benchmarks/peers_warp.py "$${given[@]}" --out out/peers/warp.json
	$(BIN)/python benchmarks/peers_warp.py --read out/peers/warp.json
	if [[ "$${given[*]}" == *--arosics* ]]; then
	    $(BIN)/python benchmarks/peers.py orthos --arosics out/peers/arosics/bin/python --seeds 6000:6008
	fi

# Which interpreters, each with the system's GDAL or the extra `wheel`.
PYTHONS ?= $(PYTHON)=system
packages:
	@bash tools/clean_install.sh $(PYTHONS)

docs: setup
	@$(BIN)/python docs/make_tutorial_images.py
	$(BIN)/python docs/make_reference.py
	$(BIN)/python docs/make_notebooks.py --pages
	$(BIN)/python docs/make_commands.py
	$(BIN)/python docs/make_man.py
	rm -rf docs/__pycache__
	$(BIN)/python tools/requirements.py docs | $(BIN)/pip install --quiet --require-hashes -c tools/constraints.txt -r /dev/stdin
	$(BIN)/zensical build --strict --clean
	echo "Site:    $(CURDIR)/out/site/index.html"
	echo "Manual:  man -l $(CURDIR)/out/man/ortho.1"

images: setup
	@$(BIN)/python docs/make_images.py
	$(BIN)/python docs/make_measure_images.py
	$(BIN)/python docs/make_report_images.py
	$(BIN)/python docs/make_tutorial_images.py
	$(BIN)/python docs/make_notebooks.py

constraints: setup
	@$(BIN)/pip install --quiet --require-hashes -c tools/constraints.txt uv
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --upgrade --all-extras \
	    --custom-compile-command "make constraints" -o tools/constraints.txt pyproject.toml tools/constraints.in
	git diff --stat -- tools/constraints.txt

pin-image:
	@digest="$$(docker buildx imagetools inspect "$(IMAGE)" --format '{{.Manifest.Digest}}')"
	[[ "$$digest" =~ ^sha256:[0-9a-f]{64}$$ ]] || { echo "docker gave no digest of $(IMAGE): $$digest" >&2; exit 1; }
	sed -i -E "s|^(ARG BASE=).*|\1$(IMAGE)@$$digest|" Dockerfile
	grep '^ARG BASE=' Dockerfile

clean:
	rm -rf $(VENV) out build dist .pytest_cache .hypothesis .mypy_cache .ruff_cache
