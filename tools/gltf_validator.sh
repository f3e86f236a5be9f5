#!/bin/sh
# SPDX-License-Identifier: GPL-3.0-or-later
# Fetch the Khronos glTF validator (npm package, Apache-2.0) for tests/core/texture/test_glb_validator.py.
set -eu
here=$(CDPATH= cd -- "$(dirname -- "$0")" && pwd)
target="${1:-$here/../.cache/gltf-validator}"
mkdir -p "$target"
npm install --no-audit --no-fund --prefix "$target" gltf-validator@2.0.0-dev.3.10
