#!/usr/bin/env bash
# Runs the static checks and one tier of the tests, in the order that fails fastest.
# usage: scripts/check.sh BIN TIER [PYTEST_OPTION...]       TIER: quick, test or nightly
set -euo pipefail
cd "$(dirname "$0")/.."
bin=$1 tier=$2
shift 2

"$bin/ruff" format --check --quiet .
"$bin/ruff" check --quiet .

# Types and import contracts are checked beside the tests, which leave some processor time unused.
report=$(mktemp)
{ "$bin/mypy" && "$bin/lint-imports" --no-logo; } >"$report" 2>&1 &
static=$!
trap 'kill "$static" 2>/dev/null || true; rm -f "$report"' EXIT

status=0
# A file's tests stay together, so that the servers and renders of a module are started once (tests/conftest.py).
# Three processes keep two cores busy, because some tests wait for a lease or a timeout.
"$bin/pytest" --tier "$tier" --numprocesses 3 --dist loadfile --no-loadscope-reorder "$@" || status=$?
if ! wait "$static"; then
    cat "$report"
    status=1
fi
exit "$status"
