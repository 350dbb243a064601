#!/usr/bin/env bash
# Runs the tests with the lowest versions that pyproject.toml permits, in a temporary environment: files, commands and
# stacks, then the quick tests of the algorithms. Needs uv (pip install uv) and 8 GB of disk for PyTorch with CUDA,
# which also runs without a GPU. --slow also runs the long tests of the first part.
set -euo pipefail
marker="not slow"
if [ "${1:-}" = --slow ]; then marker="slow or not slow"; fi
cd "$(dirname "$0")/.."
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
uv venv --quiet "$folder/venv"
uv pip install --quiet --python "$folder/venv/bin/python" --resolution lowest-direct '.[formats,tables,video]' \
  'pytest>=8.3' 'hypothesis>=6.100' 'scikit-image>=0.25'
export OMP_WAIT_POLICY=${OMP_WAIT_POLICY:-passive} OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
export PYTHONWARNINGS=ignore::DeprecationWarning # of the programs that tests start
# old packages use names that newer ones of their dependencies deprecate
old=(-W ignore::DeprecationWarning -W ignore::PendingDeprecationWarning)
"$folder/venv/bin/python" -c 'import torch; print("lowest versions: torch", torch.__version__)'
"$folder/venv/bin/python" -m pytest "${old[@]}" -m "$marker" tests/test_config.py tests/test_start.py tests/commands \
  tests/io tests/report tests/video tests/registration tests/augmentation tests/evaluation/test_quality.py tests/stacks
"$folder/venv/bin/python" -m pytest "${old[@]}" tests --quick
