#!/usr/bin/env bash
# Runs the quick tests of the core with the base dependencies only, on every version of Python that is found: with 3.11
# in the lowest versions that pyproject.toml allows, with others in the newest.
# usage: scripts/versions.sh                      all versions in pyproject.toml but 3.11; one without interpreter is skipped
#        scripts/versions.sh VERSION...           these versions, such as 3.12 3.13; all are needed
#        scripts/versions.sh --find VERSION       prints the interpreter; exit status 1 if there is none
set -euo pipefail
cd "$(dirname "$0")/.."

# Prints the first interpreter of a version that starts: pyenv puts shims on the PATH that may have nothing to start.
find_interpreter() {
    local version=$1 candidate
    while IFS= read -r candidate; do
        if [ "$("$candidate" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)" = "$version" ]; then
            echo "$candidate"
            return
        fi
    done < <(
        type -ap "python$version" || true
        compgen -G "${PYENV_ROOT:-$HOME/.pyenv}/versions/$version.*/bin/python" || true
    )
    return 1
}

if [ "${1:-}" = --find ]; then
    find_interpreter "$2"
    exit
fi

read -ra versions <<<"$*"
if [ ${#versions[@]} = 0 ]; then
    mapfile -t versions < <(sed -n 's/^ *"Programming Language :: Python :: \(3\.[0-9]*\)".*/\1/p' pyproject.toml | grep -vx '3\.11')
fi

failed=()
for version in "${versions[@]}"; do
    if ! python=$(find_interpreter "$version"); then
        echo "Python $version: skipped, no interpreter was found"
        [ $# = 0 ] || failed+=("$version")
        continue
    fi
    scripts/environment.sh "$python" ".venv-$version" test
    if ".venv-$version/bin/python" -m pytest --quiet --tier quick --numprocesses 2 -p no:cacheprovider tests/bench; then
        echo "Python $version: passed with $python"
    else
        failed+=("$version")
    fi
done
if [ ${#failed[@]} != 0 ]; then
    echo "error: the tests failed with Python ${failed[*]}" >&2
    exit 1
fi
