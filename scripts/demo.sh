#!/usr/bin/env bash
# Sets up .venv, then simulates, detects and restores two drawn scenes into out/demo/. Options go to demo.py.
set -euo pipefail
cd "$(dirname "$0")/.."
bash scripts/setup.sh
export OMP_WAIT_POLICY=${OMP_WAIT_POLICY:-passive} # threads that wait by spinning crawl where cores are shared
exec .venv/bin/python scripts/demo.py "$@"
