# SPDX-License-Identifier: GPL-3.0-or-later
PY := .venv/bin/python

.PHONY: demo test lint zip prepare blenders settings-table clean

prepare:
	@bash tools/prepare.sh

demo: prepare
	$(PY) gaussian_wrapping_addon/batch.py wrap examples/bananas --out demo_out --preset draft

test: lint blenders
	$(PY) -m pytest

lint: prepare
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy

blenders: prepare
	@bash tools/test_blenders.sh

settings-table: prepare
	$(PY) -m tools.settings_table

zip: prepare
	$(PY) build_addon.py

clean:
	rm -rf demo_out dist .pytest_cache .mypy_cache .ruff_cache
