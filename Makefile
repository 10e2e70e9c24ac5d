# Every target first installs what it needs into .venv, with the versions of constraints.txt.
#
# make demo      simulate a room, fit a map, evaluate it and draw it (out/); installs the package alone
# make test      run linter, type checker and all tests
# make check     the same with the quickest tests of every part
# make docs      build the documentation (out/docs/index.html); warnings are errors
# make wheel     build the pure wheel and the one for Linux on x86-64 with the native library (out/wheels/)
# make try-wheel install the latter without a compiler; compare its speed with a library compiled here
# make versions  try that wheel with old and new versions of Python and the libraries (gigabytes)
# make sanitize  run the native tests with AddressSanitizer and UndefinedBehaviorSanitizer (minutes)
# make try-viewer drive the viewer in Chromium: times and screenshots (out/viewer/); needs ../shared/data
# make bench     run the benchmarks (minutes)
# make soak      run the long tests: extras, fuzzing, flipped bits, kills, full disks (tens of minutes)

PYTHON ?= python3
BIN := .venv/bin
INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt \
	$(shell grep -o '^torch==[^ ]*' constraints.txt)
WHEELS := out/wheels
DATA ?= ../shared/data
QUICK := public scans sampling features io_npz simulation kernel_cache native_query native_extremes \
	native_gradients native_update marching atomic_files
PARALLEL := -n auto --maxprocesses 8 --dist loadfile  # a process for each core
# Run by `make soak` only: they take as long as hundreds of others.
LONG := tests/test_streaming.py::test_a_stream_killed_at_any_moment_ends_as_if_it_had_not_been \
	tests/test_tiles_fitting.py::test_killed_at_a_random_moment_the_job_ends_with_the_same_files \
	tests/test_docs.py::test_the_documentation_builds_without_a_warning \
	tests/test_io_broken.py::test_fifty_broken_files_of_each_format_neither_crash_nor_hang \
	tests/test_gpu_check.py::test_tensors_on_another_device_are_found_with_the_line_that_made_them \
	tests/test_class_training.py::test_classes_without_occupancy_are_told_apart_as_by_logistic_regression_on_rbf \
	tests/test_torch_func.py::test_an_exported_map_loads_in_a_new_process \
	tests/test_collision.py::test_gradients_pass_gradcheck_for_ways_and_for_the_map \
	tests/test_bodies.py::test_gradients_with_respect_to_poses_pass_gradcheck
# `make test` skips what needs large libraries that are not installed for it.
EXTRAS := tests/test_onnx_files.py tests/test_rerun_files.py tests/test_kiss_icp_poses.py
export MPLBACKEND := Agg

.PHONY: demo test check bench soak docs wheel try-wheel versions sanitize try-viewer
.DELETE_ON_ERROR:

.venv/demo: pyproject.toml constraints.txt
	@echo "installing torch and the other libraries into .venv; pip downloads what its cache lacks"
	$(PYTHON) -m venv .venv
	$(INSTALL) -e .
	@touch $@

.venv/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(INSTALL) -e '.[dev]'
	touch $@ .venv/demo

.venv/bench: .venv/ready
	$(INSTALL) -e '.[bench]'
	touch $@

.venv/extras: .venv/ready
	$(INSTALL) -e '.[onnx,rerun,kiss-icp]'
	touch $@

.venv/wheel: .venv/ready
	$(INSTALL) -e '.[wheel]'
	touch $@

demo: .venv/demo
	@echo "running the demo: about a minute, most of it to compile the native library the first time"
	$(BIN)/python scripts/demo.py out

test: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	@$(BIN)/python -c "from lardhm_torch import native; native.available()"  # compile the native library once
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(PARALLEL) $(LONG:%=--deselect %)

check: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	@$(BIN)/python -c "from lardhm_torch import native; native.available()"
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(PARALLEL) $(QUICK:%=tests/test_%.py)

wheel: .venv/wheel
	$(BIN)/python scripts/wheels/build_wheels.py $(WHEELS)

try-wheel: wheel
	$(BIN)/python scripts/wheels/try_wheels.py $(WHEELS)

versions: wheel
	$(BIN)/python scripts/versions/try_versions.py $(WHEELS)/*manylinux*.whl

sanitize: .venv/ready
	$(BIN)/python scripts/sanitize.py

docs: .venv/ready
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs out/docs
	@echo "documentation: out/docs/index.html"

try-viewer: .venv/ready
	$(BIN)/python scripts/drive_viewer.py $(DATA) -o out/viewer

bench: .venv/bench
	$(BIN)/python benchmarks/speed.py
	$(BIN)/python benchmarks/accuracy.py

soak: .venv/extras
	$(BIN)/python -m pytest $(LONG) $(EXTRAS)
	$(BIN)/python scripts/fuzz_readers.py
	$(BIN)/python scripts/soak_bits.py --flips 1000 --seed 0
	$(BIN)/python scripts/soak_kills.py --kills 50 --seed 0
	$(BIN)/python scripts/soak_tiles.py --kills 50 --seed 0
	$(BIN)/python scripts/soak_saves.py --kills 50 --seed 0
	$(BIN)/python scripts/soak_readers.py --seconds 60
