#!/usr/bin/env bash
# Creates .venv, checks format, lint and types, and runs the tests. --slow also runs the long tests.
set -euo pipefail
cd "$(dirname "$0")/.."
marker="not slow"
for argument in "$@"; do
  case "$argument" in
    --slow) marker="slow or not slow" ;;
    *) echo "test.sh: unknown argument '$argument'; the only one is --slow" >&2; exit 2 ;;
  esac
done
bash scripts/setup.sh
export OMP_WAIT_POLICY=${OMP_WAIT_POLICY:-passive} # busy-waiting threads are slow on shared cores
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}       # one process per core instead of threads
.venv/bin/python -m ruff format --check .
.venv/bin/python -m ruff check .
.venv/bin/python -m mypy & # beside the tests, most of which it ends before
types=$!
.venv/bin/python -m pytest -m "$marker" -n auto --dist loadfile --no-loadscope-reorder || { kill $types 2>/dev/null || true; exit 1; }
wait $types
