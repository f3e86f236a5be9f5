#!/usr/bin/env bash
# SPDX-License-Identifier: GPL-3.0-or-later
# Make the Blenders that the tests use beside the bpy wheel of .venv, where this machine can:
#   .cache/bpy-4.2   the bpy wheel of the oldest Blender that the add-on supports (Python 3.11)
#   .cache/blender   a real Blender with a window (tools/real_blender.sh; Debian, as root)
# It never fails: where one cannot be had, the reason is kept in .cache/<name>.why-not and told by the
# tests that skip. GW_NO_BLENDERS=1 leaves both out; BLENDER=/path/to/blender uses that one instead.
set -uo pipefail
cd "$(dirname "$0")/.."
mkdir -p .cache

OLDEST=4.2.23
say() { printf '%s\n' "$*" >&2; }
why_not() { # name, reason
  printf '%s' "$2" >".cache/$1.why-not"
  say "Tests in $1 are left out: $2"
}

oldest() {
  local python=.venv/bin/python home=.cache/bpy-4.2
  if ! "$python" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))'; then
    why_not bpy-4.2 "bpy $OLDEST exists for Python 3.11 only, .venv has another"
    return
  fi
  if [ "$(cat "$home/requirements.stamp" 2>/dev/null)" != "bpy==$OLDEST" ]; then
    say "Making $home with bpy $OLDEST (about 1 GB, half a minute)"
    rm -rf "$home"
    if ! { "$python" -m venv "$home" && timeout 900 "$home/bin/python" -m pip install -q \
      --disable-pip-version-check "bpy==$OLDEST" "numpy<2"; } >.cache/bpy-4.2.log 2>&1; then
      rm -rf "$home"
      why_not bpy-4.2 "bpy $OLDEST could not be installed, see .cache/bpy-4.2.log"
      return
    fi
    printf 'bpy==%s' "$OLDEST" >"$home/requirements.stamp"
  fi
  rm -f .cache/bpy-4.2.why-not
}

real() {
  if [ -n "${BLENDER:-}" ]; then
    rm -f .cache/blender.why-not
    return
  fi
  if [ "$(uname -s)" != Linux ] || ! command -v apt-get >/dev/null 2>&1; then
    why_not blender "tools/real_blender.sh knows Debian alone; set BLENDER=/path/to/blender"
    return
  fi
  if [ "$(id -u)" != 0 ]; then
    why_not blender "tools/real_blender.sh needs root; set BLENDER=/path/to/blender"
    return
  fi
  say "Setting up a real Blender in .cache/blender (1.3 GB, 1 to 3 minutes the first time)"
  if ! timeout 1200 bash tools/real_blender.sh >.cache/blender.log 2>&1; then
    why_not blender "tools/real_blender.sh failed: $(tail -n 1 .cache/blender.log)"
    return
  fi
  rm -f .cache/blender.why-not
}

if [ -n "${GW_NO_BLENDERS:-}" ]; then
  why_not bpy-4.2 "GW_NO_BLENDERS is set"
  why_not blender "GW_NO_BLENDERS is set"
  exit 0
fi
oldest
real
exit 0
