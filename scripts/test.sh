#!/usr/bin/env bash
# The fast tests; arguments go to pytest (for example: -m slow, -k circle).
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/environment.sh
prepare "[dev]"
if [ $# -eq 0 ]; then set -- -m "not slow"; fi
echo "running the tests on ${PYTEST_WORKERS:-2} processes"
# One thread per process: two processes that spin on each other's BLAS threads take twice as long.
# Each process takes tests that stand beside each other, so that what a module makes once is made by one process.
OPENBLAS_NUM_THREADS=1 .venv/bin/python -m pytest -q -n "${PYTEST_WORKERS:-2}" --dist worksteal "$@"
