# Every target first installs the package into .venv.
#
# make demo   simulate a room, fit a map, evaluate it and draw it (out/)
# make test   run linter, type checker and tests
# make docs   build the documentation (out/docs/index.html); warnings are errors
# make bench  run the benchmarks (minutes)
# make soak   run the long tests: fuzzing, flipped bits, kills, full disks (tens of minutes)

PYTHON ?= python3
BIN := .venv/bin
export MPLBACKEND := Agg

.PHONY: demo test bench soak docs
.DELETE_ON_ERROR:

.venv/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt \
		$(shell grep -o '^torch==[^ ]*' constraints.txt) -e '.[dev]'
	touch $@

.venv/bench: .venv/ready
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[bench]'
	touch $@

demo: .venv/ready
	$(BIN)/python scripts/demo.py out

test: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest

docs: .venv/ready
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs out/docs
	@echo "documentation: out/docs/index.html"

bench: .venv/bench
	$(BIN)/python benchmarks/speed.py
	$(BIN)/python benchmarks/accuracy.py

soak: .venv/ready
	$(BIN)/python scripts/fuzz_readers.py
	$(BIN)/python scripts/soak_bits.py --flips 1000 --seed 0
	$(BIN)/python scripts/soak_kills.py --kills 50 --seed 0
	$(BIN)/python scripts/soak_tiles.py --kills 50 --seed 0
	$(BIN)/python scripts/soak_saves.py --kills 50 --seed 0
