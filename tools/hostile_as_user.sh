#!/usr/bin/env bash
# SPDX-License-Identifier: GPL-3.0-or-later
# Run the hostile suite as another user than root, for whom files may be unreadable and folders
# read-only. Root may be in a home that the user cannot enter, so the tests run in a copy of the
# tracked files, with a Python of the system that sees the packages of .venv.
# usage: tools/hostile_as_user.sh [USER] [ARGUMENTS OF PYTEST...]
set -euo pipefail
cd "$(dirname "$0")/.."
user=${1:-nobody}
[ $# -gt 0 ] && shift

say() { printf '%s\n' "$*" >&2; }

[ "$(id -u)" = 0 ] || { say "Only root can become another user. As a user, run: make test"; exit 1; }
packages=$(.venv/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
version=$(.venv/bin/python -c 'import sys; print("%d.%d" % sys.version_info[:2])')
python=/usr/bin/python$version
if ! runuser -u "$user" -- "$python" -c 'import venv' 2>/dev/null; then
  say "$user has no $python. Install python$version of the system, or make .venv with another one."
  exit 1
fi
if ! runuser -u "$user" -- test -r "$packages/pytest/__init__.py"; then
  say "$user cannot read $packages. Put the repository where it can."
  exit 1
fi

place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
mkdir "$place/repository" "$place/home" "$place/tmp"
git ls-files -z | tar --null -T - -cf - | tar -xf - -C "$place/repository"
chown -R "$user" "$place"
"$python" -m venv --without-pip "$place/venv"
echo "$packages" >"$place/venv/lib/python$version/site-packages/packages.pth"
cd "$place/repository"
runuser -u "$user" -- env HOME="$place/home" TMPDIR="$place/tmp" \
  "$place/venv/bin/python" -m pytest -q -p no:cacheprovider tests/hostile "$@"
