#!/usr/bin/env bash
# Creates or updates .venv with the tested versions of all packages; does nothing if it is up to date.
# "setup.sh user" installs only what users need: the package with video and scientific formats.
set -euo pipefail
cd "$(dirname "$0")/.."
case "${1:-}" in
  "") extras='test,benchmark,docs' ;;
  user) extras='video,formats' ;;
  *) echo "setup: unknown argument '$1'; the only one is user" >&2; exit 2 ;;
esac
python=${PYTHON:-}
if [ -z "$python" ]; then
  for candidate in python3.11 python3 python3.12 python3.13; do
    if command -v "$candidate" >/dev/null 2>&1 && "$candidate" -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; then
      python=$candidate
      break
    fi
  done
fi
if [ -z "$python" ]; then
  echo "setup: Python 3.11 or newer with venv is needed (Debian: apt-get install python3-venv)" >&2
  exit 2
fi
stamp=$(cat pyproject.toml scripts/constraints.txt | cksum)
installed=$(cat .venv/installed 2>/dev/null || true)
case "$installed" in "$stamp $extras" | "$stamp test,benchmark,docs") current=true ;; *) current=false ;; esac
if ! $current || ! .venv/bin/rsvib --version >/dev/null 2>&1; then
  echo "setup: installing into .venv (a few minutes the first time)"
  [ -x .venv/bin/python ] || "$python" -m venv .venv
  # bytecode is made on all processors, because pip uses one; some templates in packages cannot be compiled
  .venv/bin/python -m pip install --quiet --no-compile --disable-pip-version-check -c scripts/constraints.txt -e ".[$extras]"
  .venv/bin/python -m compileall -q -j 0 .venv/lib > /dev/null || true
  printf '%s' "$stamp $extras" > .venv/installed
fi
