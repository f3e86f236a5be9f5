# SPDX-License-Identifier: GPL-3.0-or-later
PY := .venv/bin/python

# One process of tests for each core, at most four; each file stays in one: fixtures are made once.
PARALLEL := -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder

.PHONY: demo test quick proofs lint docs settings-table zip prepare blenders clean

prepare:
	@bash tools/prepare.sh

demo: prepare
	$(PY) gaussian_wrapping_addon/batch.py wrap examples/bananas --out demo_out --preset draft

test: lint
	$(PY) -m pytest $(PARALLEL)

quick: lint
	$(PY) -m pytest $(PARALLEL) -q -m "not slow and not proof"

proofs: lint blenders
	$(PY) -m pytest $(PARALLEL) -m proof

lint: prepare
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy

blenders: prepare
	@bash tools/test_blenders.sh

settings-table: prepare
	$(PY) -m tools.settings_table

docs: .venv-docs/requirements.stamp
	NO_MKDOCS_2_WARNING=1 .venv-docs/bin/python -m mkdocs build --strict

.venv-docs/requirements.stamp: requirements-docs.txt
	python3 -m venv .venv-docs
	.venv-docs/bin/python -m pip install -q --disable-pip-version-check -r requirements-docs.txt
	@cp requirements-docs.txt $@

zip: prepare
	$(PY) build_addon.py

clean:
	rm -rf demo_out dist site .pytest_cache .mypy_cache .ruff_cache
