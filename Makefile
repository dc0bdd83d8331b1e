# make demo   the main job on a bench log that the project makes itself; CONFIG=FILE fits yours,
#             OUT=DIR says into which new directory (default: runs/NAME-DATE-TIME)
# make test   all checks; where CI=true without the slowest tests
# make docs   the documentation site, into site/
# make bench  the benchmarks, side by side in one run
.PHONY: demo test docs bench clean
SHELL := /bin/bash
CONFIG ?= configs/bench-roll.yaml
BIN := .venv/bin

.venv/.installed: pyproject.toml constraints.txt
	@found=; for p in python3.13 python3.12 python3 "$$(uv python find '>=3.12' 2>/dev/null)"; do \
	  if [ -n "$$p" ] && "$$p" -c 'import sys, venv; sys.exit(sys.version_info < (3, 12))' >/dev/null 2>&1; \
	  then found="$$p"; break; fi; done; \
	if [ -z "$$found" ]; then \
	  echo "heli_jax needs Python 3.12 or newer: install python3.13 (with its venv module) or uv." >&2; exit 1; fi; \
	if [ ! -x $(BIN)/python ]; then "$$found" -m venv .venv || exit 1; fi; \
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev,logs,fused,bayes,distributed,docs]' -c constraints.txt
	@touch $@

demo: .venv/.installed
ifeq ($(CONFIG),configs/bench-roll.yaml)
	@$(BIN)/heli-jax simulate $(CONFIG) --out runs/demo/bench.csv
endif
	@$(BIN)/heli-jax fit '$(CONFIG)' $(if $(OUT),--out '$(OUT)')

# Types are checked beside the tests: pyright alone leaves a core idle for three minutes.
# Compiled modules are kept: a dozen tests start processes of their own, which would compile all anew.
test: export PYTHONDONTWRITEBYTECODE :=
test: .venv/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell
	@$(BIN)/pyright & types=$$!; \
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal; tests=$$?; \
	wait $$types && exit $$tests

docs: .venv/.installed
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo site/index.html

bench: .venv/.installed
	$(BIN)/python experiments/benchmarks/identification.py
	$(BIN)/python experiments/benchmarks/helicopter.py
	$(BIN)/python experiments/benchmarks/sweeps.py
	$(BIN)/python experiments/benchmarks/filter.py

clean:
	rm -rf .venv site .pytest_cache .ruff_cache
