#!/usr/bin/env bash
# SPDX-License-Identifier: GPL-3.0-or-later
# Make .venv with the pinned packages, after checking for the system libraries that bpy needs.
# As root on Debian or Ubuntu, missing ones are installed; otherwise they are named.
set -euo pipefail
cd "$(dirname "$0")/.."

say() { printf '%s\n' "$*" >&2; }

# shared library -> Debian package; the last three are for rendering without a display
libraries="libX11.so.6:libx11-6 libXrender.so.1:libxrender1 libXfixes.so.3:libxfixes3
libXi.so.6:libxi6 libxkbcommon.so.0:libxkbcommon0 libSM.so.6:libsm6 libGL.so.1:libgl1
libgomp.so.1:libgomp1 libEGL.so.1:libegl1 libEGL_mesa.so.0:libegl-mesa0
libgbm.so.1:libgl1-mesa-dri"

missing=""
if [ "$(uname -s)" = Linux ]; then
  known=$(PATH="$PATH:/sbin:/usr/sbin" ldconfig -p 2>/dev/null || true)
  for entry in $libraries; do
    case "$known" in *"${entry%%:*}"*) ;; *) missing="$missing ${entry##*:}" ;; esac
  done
fi

python=""
for name in ${PYTHON:-} python3.11 python3.13 python3.12 python3; do
  if command -v "$name" >/dev/null 2>&1 &&
    "$name" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then
    python=$name
    break
  fi
done
if [ -z "$python" ]; then
  say "No Python 3.11 or newer was found. Install python3.11 (Debian 12: apt-get install python3)."
  exit 1
fi
if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
  missing="$missing $("$python" -c 'import sys; print(f"python{sys.version_info[0]}.{sys.version_info[1]}-venv")')"
fi

if [ -n "$missing" ]; then
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null 2>&1; then
    say "Installing system packages:$missing"
    apt-get update -qq
    # shellcheck disable=SC2086
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $missing >/dev/null
  else
    say "These system packages are missing:$missing"
    say "Install them, for example: sudo apt-get install$missing"
    exit 1
  fi
fi

stamp=.venv/requirements.stamp
wanted=$(cat requirements-worker.txt requirements-dev.txt requirements-stubs.txt)
if [ ! -f "$stamp" ] || [ "$(cat "$stamp")" != "$wanted" ]; then
  say "Making .venv (about 2 GB; a few minutes the first time) with $("$python" --version)"
  [ -x .venv/bin/python ] || "$python" -m venv .venv
  .venv/bin/python -m pip install -q --disable-pip-version-check -r requirements-dev.txt
  rm -rf .venv/stubs
  .venv/bin/python -m pip install -q --disable-pip-version-check --no-deps \
    --target .venv/stubs -r requirements-stubs.txt
  printf '%s' "$wanted" >"$stamp"
fi
