#!/usr/bin/env bash
# SPDX-License-Identifier: GPL-3.0-or-later
# A real Blender with a window, for the tests of tests/gui, on a Debian machine whose own release has
# none or an old one. It fills a folder with a small Debian of another suite (trixie: Blender 4.3.2;
# sid: 5.2) from the mirror that apt uses already, and writes a launcher that runs Blender in it:
#
#   bash tools/real_blender.sh                           # 1 to 3 minutes, 1.3 GB; does nothing when done
#   .cache/blender/blender-real --version
#   .cache/blender/blender-real --background -P FILE.py  # without a window
#   .cache/blender/blender-real --gui -P FILE.py         # with a window (Xvfb, software OpenGL)
#   .cache/blender/blender-real --sh 'COMMAND'           # anything else inside (import, xdotool, ...)
#
# Environment: GW_BLENDER_HOME (default .cache/blender), GW_BLENDER_SUITE (default trixie); for the
# launcher also GW_BIND (more folders to show inside at the same path, separated by ":"),
# GW_GEOMETRY (default 1400x900), GW_HOME (the home folder inside).
# Needs root. All mounts live in a private namespace of the launcher: nothing stays mounted.
set -euo pipefail
SUITE="${GW_BLENDER_SUITE:-trixie}"
BASE="${GW_BLENDER_HOME:-$(cd "$(dirname "$0")/.." && pwd)/.cache/blender}"
ROOT="$BASE/$SUITE"
PACKAGES="blender python3-numpy python3-requests python3-zstandard xvfb libgl1-mesa-dri libegl1 libegl-mesa0 imagemagick xdotool x11-utils fonts-dejavu-core"
[ "$SUITE" = sid ] && PACKAGES="$PACKAGES python3-cattr"   # 5.x: its extension manager imports cattrs
STAMP="$ROOT/.gw-ready"

say() { echo "real_blender: $*"; }
[ "$(id -u)" = 0 ] || { say "must run as root"; exit 2; }
mkdir -p "$BASE"

# ---- the mirror, from this machine's own apt configuration (never printed) -----------------
mirror() {
  local code; code="$(. /etc/os-release; echo "${VERSION_CODENAME:-}")"
  # both deb822 and one-line sources; the archive (not the security one) of our own release
  apt-get indextargets --format '$(REPO_URI) $(RELEASE)' 2>/dev/null |
    awk -v c="$code" '$2==c {sub(/\/$/,"",$1); print $1; exit}'
}

if [ -f "$STAMP" ] && [ "$(cat "$STAMP")" = "$PACKAGES" ]; then
  say "already set up in $ROOT"
else
  T0=$(date +%s)
  M="$(mirror)"
  [ -n "$M" ] || { apt-get -qq update; M="$(mirror)"; }
  [ -n "$M" ] || { say "no Debian mirror found in the apt configuration"; exit 3; }
  if ! command -v debootstrap >/dev/null; then
    apt-get -qq update
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends debootstrap >/dev/null
  fi
  if [ ! -f "$ROOT/.gw-base" ]; then
    rm -rf --one-file-system "$ROOT"
    debootstrap --variant=minbase --include=ca-certificates "$SUITE" "$ROOT" "$M" >"$BASE/debootstrap.log" 2>&1 ||
      { say "debootstrap failed, see $BASE/debootstrap.log"; exit 4; }
    touch "$ROOT/.gw-base"
  fi
  say "base system after $(( $(date +%s) - T0 )) s"
  cp -L /etc/resolv.conf "$ROOT/etc/resolv.conf"
  cp -L /etc/hosts "$ROOT/etc/hosts"
  # the same download settings (proxy, validity checks, retries) that apt has outside
  apt-config dump | grep -E '^Acquire::(Check-|Retries|http|https)' >"$ROOT/etc/apt/apt.conf.d/90gw" || true
  printf 'path-exclude=/usr/share/doc/*\npath-exclude=/usr/share/man/*\n' >"$ROOT/etc/dpkg/dpkg.cfg.d/gw"
  printf '#!/bin/sh\nexit 101\n' >"$ROOT/usr/sbin/policy-rc.d"; chmod +x "$ROOT/usr/sbin/policy-rc.d"
  unshare -m sh -c '
    mount -t proc proc "$1/proc" && mount -t tmpfs tmpfs "$1/tmp"
    exec chroot "$1" env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin LANG=C.UTF-8 DEBIAN_FRONTEND=noninteractive sh -ec "
      apt-get -qq update
      apt-get install -y -qq --no-install-recommends $2
      apt-get clean; rm -rf /var/lib/apt/lists/*
    "' sh "$ROOT" "$PACKAGES" >"$BASE/install.log" 2>&1 || { say "install failed, see $BASE/install.log"; exit 5; }
  echo "$PACKAGES" >"$STAMP"
  say "ready after $(( $(date +%s) - T0 )) s, $(du -shx "$ROOT" | cut -f1)"
fi

ln -sfn /proc/self/mounts "$ROOT/etc/mtab"   # else Blender warns "could not get a list of mounted file-systems"

# ---- the launcher ---------------------------------------------------------------------------
cat >"$BASE/blender-real" <<'LAUNCH'
#!/usr/bin/env bash
# blender-real [--gui] ARGS... | --sh 'COMMAND': the real Blender, in a private mount namespace.
set -euo pipefail
BASE="$(cd "$(dirname "$(readlink -f "$0")")" && pwd)"
export GW_ROOT="$BASE/${GW_BLENDER_SUITE:-trixie}" GW_CWD="$PWD" GW_BASE="$BASE"
exec unshare -m bash -euo pipefail -c '
  R=$GW_ROOT
  bindat() { [ -d "$1" ] || return 0; mkdir -p "$R$1"; mount --rbind "$1" "$R$1"; }
  mount -t proc proc "$R/proc"
  mount -t tmpfs tmpfs "$R/dev"; mkdir -p "$R/dev/shm"
  for n in null zero full random urandom tty; do : >"$R/dev/$n"; mount --bind "/dev/$n" "$R/dev/$n"; done
  mount -t tmpfs tmpfs "$R/dev/shm"
  # host folders at the same path: the work folder, /tmp (test data, X socket), and the host Python with its venvs
  top="$(git -C "$GW_CWD" rev-parse --show-toplevel 2>/dev/null || echo "$GW_CWD")"
  pypre="$(python3 -c "import sys; print(sys.base_prefix)" 2>/dev/null || true)"
  IFS=: read -ra extra <<<"${GW_BIND:-}"
  seen=:/usr:/:
  for d in /tmp "$top" "$pypre" "${extra[@]}"; do
    [ -n "$d" ] || continue; case "$seen" in *":$d:"*) continue;; esac; seen="$seen$d:"
    case "$d" in /tmp/*) continue;; esac
    bindat "$d"
  done
  HOMEDIR="${GW_HOME:-/root}"; mkdir -p "$R$HOMEDIR"
  pre=(); prog=(blender)
  if [ "${1:-}" = --gui ]; then
    shift; G="${GW_GEOMETRY:-1400x900}"
    # not xvfb-run: its clean-up is racy (seen: exit 5 and an Xvfb left behind)
    pre=(sh -c "mkfifo /dev/shm/gwd; Xvfb -displayfd 3 -screen 0 ${G}x24 -nolisten tcp 3>/dev/shm/gwd >/dev/null 2>&1 & x=\$!
      trap \"kill \$x 2>/dev/null\" EXIT; trap \"exit 143\" TERM INT
      read -r n </dev/shm/gwd && DISPLAY=:\$n \"\$@\"" sh)
    prog=(blender --window-geometry 0 0 "${G%x*}" "${G#*x}")
  elif [ "${1:-}" = --sh ]; then shift; prog=(sh -c); fi
  keep=(); while IFS="=" read -r k _; do case "$k" in GW_*|BLENDER_*|GAUSSIAN_*|CI|PYTEST_*) keep+=("$k=${!k}");; esac; done < <(env)
  exec chroot "$R" env -i HOME="$HOMEDIR" PATH=/usr/sbin:/usr/bin:/sbin:/bin LANG=C.UTF-8 LIBGL_ALWAYS_SOFTWARE=1 \
    ${keep[@]+"${keep[@]}"} sh -c "cd \"\$GW_CWD\" 2>/dev/null || cd /; exec \"\$@\"" sh ${pre[@]+"${pre[@]}"} "${prog[@]}" "$@"
' blender-real "$@"
LAUNCH
chmod +x "$BASE/blender-real"
"$BASE/blender-real" --version | head -1
