# make repro, make test and make acceptance create .venv and install what they need; the second time that is quick.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
export PATH := $(CURDIR)/$(BIN):$(PATH)

.PHONY: venv repro test test-slow lint format bench acceptance recordings clean

venv: $(STAMP)

# torch first and pinned: an unpinned one brings gigabytes of CUDA builds
$(STAMP): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "torch==2.13.0"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[dev]"
	touch $@

repro: venv
	dvc repro

test: lint
	python -m pytest

test-slow: venv
	python -m pytest -m slow

lint: venv
	ruff check .
	ruff format --check .
	mypy

format: venv
	ruff format .
	ruff check --fix .

bench: venv
	diffcloud bench

# RELEASE: the folder of the published data that holds lift_real_pcls/ and conf/.
# REFERENCE: a folder of recorded reference trajectories; by default `diffsim` beside the published data, if it is there.
REFERENCE ?= $(wildcard $(RELEASE)/../../diffsim)
acceptance: venv
	@test -n "$(RELEASE)" || { echo "Usage: make acceptance RELEASE=DIR [REFERENCE=DIR]"; exit 2; }
	diffcloud acceptance --release "$(RELEASE)" $(if $(REFERENCE),--reference "$(REFERENCE)") --out docs/results

# Synthetic raw recordings against their truth, as clouds and through fits.
RECORDINGS := build/recordings
RECORDINGS_PARAMS := docs/results/raw-recordings.yaml
recordings: venv
	diffcloud episodes --params $(RECORDINGS_PARAMS) --out $(RECORDINGS)/raw
	diffcloud preprocess --params $(RECORDINGS_PARAMS) --out $(RECORDINGS)/clouds $(RECORDINGS)/raw
	diffcloud recordings --params $(RECORDINGS_PARAMS) --recorded $(RECORDINGS)/raw --episodes $(RECORDINGS)/clouds \
	    --out docs/results/raw-recordings.md

clean:
	rm -rf $(VENV) build *.egg-info .mypy_cache .ruff_cache .pytest_cache
