#!/usr/bin/env bash
# Everything CI runs, in the order that fails fastest. usage: scripts/check.sh BIN
set -euo pipefail
cd "$(dirname "$0")/.."
bin=$1

command -v chromium >/dev/null || command -v google-chrome >/dev/null ||
    echo "warning: no chromium on the PATH: the browser tests will fail; on Debian: apt-get install chromium" >&2
"$bin/ruff" format --check .
"$bin/ruff" check .
"$bin/mypy"
"$bin/lint-imports"
"$bin/pytest" "${@:2}"
