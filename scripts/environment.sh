#!/usr/bin/env bash
# Makes or reuses a virtual environment with one of the project's extras.
# The extra "test" works on any supported version of Python: with 3.11 it installs the lowest versions of the base
# package's dependencies that pyproject.toml allows, with others the newest.
# usage: scripts/environment.sh PYTHON VENV EXTRA
set -euo pipefail
cd "$(dirname "$0")/.."
python=$1 venv=$2 extra=$3

fail() {
    echo "error: $1" >&2
    exit 1
}

command -v "$python" >/dev/null 2>&1 ||
    fail "$python is not on the PATH; install Python 3.11 (Debian: apt-get install python3.11 python3.11-venv), which Blender 4.5 needs exactly, or name it: make PYTHON=/path/to/python3.11"
version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
[ "$version" = 3.11 ] || [ "$extra" = test ] || fail "$python is Python $version; Blender 4.5 needs exactly 3.11"
"$python" -c 'import ensurepip, venv' 2>/dev/null ||
    fail "$python lacks venv; install it (Debian: apt-get install python3.11-venv)"

# The file holds a digest of the requirements that were installed; other requirements install anew.
installed="$venv/.installed-$extra"
wanted=$(cat pyproject.toml constraints.txt | "$python" -c 'import hashlib, sys; print(hashlib.sha256(sys.stdin.buffer.read()).hexdigest())')
[ "$extra" != test ] || [ "$version" = 3.11 ] || rm -f "$installed"  # The newest versions change with time.
if [ ! -x "$venv/bin/python" ] || [ "$(cat "$installed" 2>/dev/null)" != "$wanted" ]; then
    echo "installing the environment into $venv (a few minutes the first time)" >&2
    "$venv/bin/python" -m pip --version >/dev/null 2>&1 || "$python" -m venv --clear "$venv"
    versions=(--constraint constraints.txt)
    if [ "$extra" = test ] && [ "$version" = 3.11 ]; then
        "$python" scripts/lowest_versions.py >"$venv/lowest.txt"
        versions=(--constraint "$venv/lowest.txt")
    elif [ "$extra" = test ]; then
        versions=(--upgrade --upgrade-strategy eager)
    fi
    "$venv/bin/python" -m pip install --quiet --disable-pip-version-check \
        "${versions[@]}" --editable ".[$extra]"
    echo "$wanted" >"$installed"
fi

# A library that is missing although the list of system packages has been checked.
if [ "$extra" = build ] && ! complaint=$("$venv/bin/python" -c 'import bpy' 2>&1); then
    fail "Blender's Python module does not import: $(printf '%s\n' "$complaint" | tail -n 1); on Debian: apt-get install $(awk '$1 == "blender" { printf "%s ", $3 }' scripts/system-packages.txt)"
fi
