#!/usr/bin/env bash
# Creates the virtual environment: create_venv.sh VENV PYTHON
# Needs a Python from 3.10 to 3.12 with the venv module.
set -euo pipefail

venv=$1
python=$2

fail() {
    printf 'create_venv: %s\n' "$@" >&2
    exit 1
}

command -v "$python" >/dev/null 2>&1 || fail \
    "'$python' was not found." \
    "Install it (sudo apt-get install python3 python3-venv) or name another: make PYTHON=python3.11 ..."

version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
case $version in
    3.10 | 3.11 | 3.12) ;;
    *) fail "'$python' is Python $version, but mani-skill's dependencies need 3.10, 3.11 or 3.12." \
        "Name another one: make PYTHON=python3.11 ..." ;;
esac

"$python" -c 'import venv, ensurepip' >/dev/null 2>&1 || fail \
    "'$python' has no venv module (Debian and Ubuntu package it on its own)." \
    "Install it: sudo apt-get install python3-venv"

"$python" -m venv "$venv"
"$venv/bin/python" -m pip install --quiet --upgrade "pip>=23.1" "setuptools>=77" wheel
