# make repro, make test and make acceptance create .venv and install what they need; the second time that is quick.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
export PATH := $(CURDIR)/$(BIN):$(PATH)
# the tests start hundreds of processes; without byte code each would compile the package again
unexport PYTHONDONTWRITEBYTECODE

.PHONY: venv repro baselines test tests test-slow test-longest lint format bench acceptance comparison simulated recordings moved coverage coverage-quick coverage-own hanging robustness pictures docs clean

venv: $(STAMP)

# torch first and pinned: an unpinned one brings gigabytes of CUDA builds; kernels last, which otherwise every process that
# needs one would compile for itself. --no-compile: of 23,000 files the stages import 5,000, and importing them once compiles
# these, in a third of the time; open3d by our own import, which also finds libusb on a machine that has none
IMPORTED := cma, diffcloud.regressors.training, dvc.commands.repro, dvc.repo, dvclive, matplotlib.backends.backend_agg, \
	diffcloud.jobs.evaluation, diffcloud.jobs.preprocess, diffcloud.jobs.report, diffcloud.jobs.train, trimesh

$(STAMP): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile "torch==2.13.0"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -e ".[dev]"
	$(BIN)/python -c "import $(IMPORTED); from diffcloud.io.clouds import import_open3d; import_open3d()"
	$(BIN)/diffcloud doctor --compile --json > /dev/null
	touch $@

# PROFILE: a file of parameters that takes the place of params.yaml, such as pipeline/profiles/paper.yaml
repro: venv
ifdef PROFILE
	@cmp -s "$(PROFILE)" params.yaml || git diff --quiet HEAD -- params.yaml || \
	    { echo "params.yaml has changes that are not committed, and $(PROFILE) would replace them. Commit or discard them first."; exit 2; }
	cp "$(PROFILE)" params.yaml
endif
	dvc repro

# the pipeline with search baselines, a loss landscape and twice the simulated sets, as one experiment of DVC
baselines: venv
	dvc exp run -S 'evaluate.baselines=[middle,random_search,cma_es]' -S 'evaluate.landscapes=[lift/lift_hidden1]' \
	    -S generate.train=128 -S generate.test=32

# one process per core and one more (tests/conftest.py), each with one thread: a step gains nothing from a second one
TESTS := python -m pytest -n auto --maxprocesses 8 --dist worksteal

# linters beside the tests: mypy takes a minute the first time
test: venv
	$(MAKE) --no-print-directory --jobs=2 lint tests

tests: venv
	$(TESTS)

# how soon an arm stands still is no question for a machine that runs three tests at once
test-slow: venv
	$(TESTS) -m "slow and not realtime"
	python -m pytest -m realtime tests/hardware

# minutes each on a slow machine: the lag in sixteen recordings, fits of MuJoCo towels, damaged files of each kind, an export that Newton runs
test-longest: venv
	$(TESTS) -m longest

lint: venv
	ruff check .
	ruff format --check .
	mypy

format: venv
	ruff format .
	ruff check --fix .

bench: venv
	python -m studies bench

# RELEASE: the folder of the published data that holds lift_real_pcls/ and conf/.
# REFERENCE: a folder of recorded reference trajectories; by default `diffsim` beside the published data, if it is there.
REFERENCE ?= $(wildcard $(RELEASE)/../../diffsim)
acceptance: venv
	@test -n "$(RELEASE)" || { echo "Usage: make acceptance RELEASE=DIR [REFERENCE=DIR]"; exit 2; }
	python -m studies acceptance --release "$(RELEASE)" $(if $(REFERENCE),--reference "$(REFERENCE)") --out docs/results

# the published data, all methods: RELEASE as above, REFERENCE_FITS a JSON with the reference simulator's own fits
comparison: venv
	@test -n "$(RELEASE)" || { echo "Usage: make comparison RELEASE=DIR [REFERENCE_FITS=FILE]"; exit 2; }
	python -m studies published "$(RELEASE)" $(if $(REFERENCE_FITS),--reference "$(REFERENCE_FITS)") --markdown docs/results/comparison.md

# The paper's simulated experiment on the built-in band and vest: ten targets each, networks, every method.
SIMULATED := build/simulated
SIMULATED_PARAMS := pipeline/profiles/simulated.yaml
simulated: venv
	python -m pipeline.synthesize --params $(SIMULATED_PARAMS) --out $(SIMULATED)/episodes
	python -m pipeline.fit --params $(SIMULATED_PARAMS) --out $(SIMULATED)/fits $(SIMULATED)/episodes
	set -e; for scenario in band_stretch vest_hang; do \
	    diffcloud network generate --params $(SIMULATED_PARAMS) --scene $$scenario --out $(SIMULATED)/sets/$$scenario; \
	done
	python -m pipeline.train --params $(SIMULATED_PARAMS) --data $(SIMULATED)/sets --out $(SIMULATED)/regressors
	python -m pipeline.evaluate --params $(SIMULATED_PARAMS) --fits $(SIMULATED)/fits --episodes $(SIMULATED)/episodes \
	    --regressors $(SIMULATED)/regressors --simulated $(SIMULATED)/sets --out $(SIMULATED)/reports \
	    --markdown docs/results/simulated-experiment.md

# Synthetic raw recordings against their truth, as clouds and through fits.
RECORDINGS := build/recordings
RECORDINGS_PARAMS := docs/results/raw-recordings.yaml
recordings: venv
	python -m pipeline.synthesize --params $(RECORDINGS_PARAMS) --out $(RECORDINGS)/raw
	python -m pipeline.preprocess --params $(RECORDINGS_PARAMS) --out $(RECORDINGS)/clouds $(RECORDINGS)/raw
	python -m studies recordings --params $(RECORDINGS_PARAMS) --recorded $(RECORDINGS)/raw --episodes $(RECORDINGS)/clouds \
	    --out docs/results/raw-recordings.md

# Synthetic raw recordings whose cameras and cloth are not where they are said to be.
MOVED := build/moved
NUISANCE := --nuisance none --nuisance x=10cm,y=10cm,z=2mm,tilt_x=5e-3rad,tilt_y=5e-3rad,yaw=30deg,lag=2ms
moved: venv
	set -e; for kind in together apart; do \
	    params=docs/results/moved-$$kind.yaml; \
	    python -m pipeline.synthesize --params $$params --out $(MOVED)/$$kind/raw; \
	    python -m pipeline.preprocess --params $$params --out $(MOVED)/$$kind/clouds $(MOVED)/$$kind/raw; \
	    python -m studies recordings --params $$params --recorded $(MOVED)/$$kind/raw --episodes $(MOVED)/$$kind/clouds \
	        --out docs/results/moved-$$kind.md $(NUISANCE); \
	done

# How often intervals hold the truth on cloths that MuJoCo and Newton move. What is finished is kept: build/foreign.
FOREIGN := python -m studies foreign
coverage: venv
	$(FOREIGN) --sets towels,cut,one_camera,untold,folds,newton,joint --markdown docs/results/foreign.md

coverage-quick: venv
	$(FOREIGN) --count 8

# How often intervals hold the truth: drawn cloths, recorded, fitted, and held against what was drawn; truths that fits do not
# expect; and fresh recordings of the same cloths. Then, in a folder of its own, the same for a posterior trained on simulated
# lifts of uncertain material, as those cameras see them, beside fits. Five hours on two cores; what is finished is kept.
POSTERIOR := build/coverage-posterior
COUNTED := python -m studies coverage --params docs/results/coverage.yaml
COVERAGE := $(COUNTED) --out build/coverage
BESIDE := $(COUNTED) --out $(POSTERIOR)/coverage --seed 6985324 --recordings 24 --scenario lift
DRAWN := --seed 82037895
coverage-own: venv
	$(COVERAGE) $(DRAWN) --recordings 200 --fix density
	$(COVERAGE) $(DRAWN) --recordings 200
	$(COVERAGE) --fix density --scenario lift --scenario fold --seed 7775397 --recordings 16 --truth refined
	$(COVERAGE) --fix density --scenario band_stretch --scenario vest_hang --seed 7775397 --recordings 8 --truth refined
	$(COVERAGE) --fix density --scenario lift --seed 7775397 --recordings 12 --truth finer
	$(COVERAGE) --fix density --scenario fold --seed 7775397 --recordings 6 --truth finer
	$(COVERAGE) --seed 5448382 --recordings 3 --refits 20 --fix density
	$(COVERAGE) --seed 5448382 --recordings 3 --refits 20 --markdown docs/results/coverage.md
	$(BESIDE)
	diffcloud network generate --scene lift --distribution logarithmic --train 1500 --test 375 --seed 75498966 --out $(POSTERIOR)/lift \
	    --uncertain bending=1.5x,air_density=1.3x,damping=1.5x,friction=1.3x,self_friction=1.3x
	diffcloud network train --params docs/results/posterior.yaml --scene lift --model posterior --data $(POSTERIOR)/lift \
	    --like $(POSTERIOR)/coverage/lift/episodes/0000.npz --out $(POSTERIOR)/regressors
	$(BESIDE) --checkpoint $(POSTERIOR)/regressors/posterior.safetensors --markdown docs/results/coverage-posterior.md

# The air around a real cloth that hangs and swings. DATA: the folder of its recordings (studies/hanging_cloth.py).
hanging: venv
	@test -n "$(DATA)" || { echo "Usage: make hanging DATA=DIR"; exit 2; }
	python -m studies hanging "$(DATA)"

# Every damaged file and every fault; a sample of both is part of test-slow.
robustness: venv
	python -m tests.robustness --out docs/results/robustness.md

# The pictures of README (from examples/) and of docs/concepts.md (from what `make repro` leaves in data/).
pictures: venv
	python docs/site/pictures.py
	python docs/site/physics_figures.py
	diffcloud fit examples/towel.npz --size 0.395x0.244 --density 0.24 --out build/towel
	python docs/site/motion.py

# The site of docs/, README and all commands, as files that open from disk: build/site/index.html.
docs: venv
	NO_MKDOCS_2_WARNING=1 mkdocs build --strict

clean:
	rm -rf $(VENV) build *.egg-info .mypy_cache .ruff_cache .pytest_cache
