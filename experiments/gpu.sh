#!/usr/bin/env bash
# What a GPU does beside the CPU of the same machine, in at most 8 minutes; results go to OUT.json after every step.
# usage: experiments/gpu.sh OUT.json
# PYTHON names the interpreter (default python3); experiments/gpu.py says what is measured.
set -euo pipefail
root="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
PYTHONPATH="$root${PYTHONPATH:+:$PYTHONPATH}" exec "${PYTHON:-python3}" -m experiments.gpu "$@"
