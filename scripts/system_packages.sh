#!/usr/bin/env bash
# Checks the system packages of scripts/system-packages.txt before anything is downloaded.
# As root on Debian it installs what is missing; otherwise it prints the command. Missing libraries of Blender are an
# error; without a browser, curl or nginx the tests that need them are skipped, except under CI=true, where they fail.
# usage: scripts/system_packages.sh USE...       for example: scripts/system_packages.sh blender browser uploads proxy
set -euo pipefail
list="$(dirname "$0")/system-packages.txt"
libraries=$(PATH="$PATH:/sbin:/usr/sbin" ldconfig -p 2>/dev/null || true)

is_present() { # PROBE
    case $1 in
        /*) [ -e "$1" ] ;;
        *.so.*) grep -q "[[:space:]]$1 " <<<"$libraries" ;;
        chromium) command -v chromium >/dev/null || command -v google-chrome >/dev/null ;;
        *) PATH="$PATH:/usr/sbin" command -v "$1" >/dev/null ;;
    esac
}

# Without ldconfig libraries cannot be looked up here; importing bpy then reports what is missing.
required=() optional=()
for use in "$@"; do
    while read -r kind probe package; do
        [ "$kind" = "$use" ] || continue
        if [[ $probe == *.so.* && -z $libraries ]] || is_present "$probe"; then continue; fi
        if [ "$use" = blender ]; then required+=("$package"); else optional+=("$package"); fi
    done < <(grep -v '^#' "$list")
done
missing=("${required[@]}" "${optional[@]}")
[ ${#missing[@]} -gt 0 ] || exit 0

install() {
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >/dev/null
}
if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    echo "installing system packages: ${missing[*]}" >&2
    apt-get update -qq || true
    if install "${missing[@]}"; then exit 0; fi
    if [ ${#required[@]} -gt 0 ]; then install "${required[@]}"; required=(); fi
fi

command="apt-get install ${missing[*]}"
if [ ${#required[@]} -gt 0 ] || [ "${CI:-}" = true ]; then
    echo "error: missing system packages; on Debian install them with: $command" >&2
    exit 1
fi
echo "warning: missing system packages; tests that need them are skipped; on Debian: $command" >&2
