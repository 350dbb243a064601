#!/usr/bin/env bash
# Tests files, commands and numerics with the lowest versions that pyproject.toml permits, in a temporary environment.
# Needs uv (pip install uv). --slow also runs the long tests.
set -euo pipefail
marker="not slow"
if [ "${1:-}" = --slow ]; then marker="slow or not slow"; fi
cd "$(dirname "$0")/.."
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
uv venv --quiet "$folder/venv"
uv pip install --quiet --python "$folder/venv/bin/python" --resolution lowest-direct '.[formats,distributed,video]' \
  'pytest>=8.3' 'hypothesis>=6.100' 'scikit-image>=0.25'
export OMP_WAIT_POLICY=${OMP_WAIT_POLICY:-passive}
export PYTHONWARNINGS=ignore::DeprecationWarning # of the programs that tests start
# old packages use names that newer ones of their dependencies deprecate
"$folder/venv/bin/python" -m pytest -W ignore::DeprecationWarning -W ignore::PendingDeprecationWarning -m "$marker" \
  tests/test_config.py tests/test_start.py tests/commands tests/io tests/report tests/registration tests/augmentation \
  tests/evaluation/test_quality.py tests/stacks
