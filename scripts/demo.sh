#!/usr/bin/env bash
# Creates .venv, then simulates, detects and restores two drawn scenes into out/demo/. Options are passed to demo.py.
set -euo pipefail
cd "$(dirname "$0")/.."
bash scripts/setup.sh user
export OMP_WAIT_POLICY=${OMP_WAIT_POLICY:-passive} # busy-waiting threads are slow on shared cores
exec .venv/bin/python scripts/demo.py "$@"
