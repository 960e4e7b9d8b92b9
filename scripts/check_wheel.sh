#!/usr/bin/env bash
# Builds the wheel, installs it in a clean environment and steps a task there:
# check_wheel.sh VENV
#
# The clean environment borrows the dependencies of VENV, but not VENV's editable install
# of this project: import hooks of a folder that is only on the path do not run.
set -euo pipefail

root=$(cd "$(dirname "$0")/.." && pwd)
python=$(cd "$1" && pwd)/bin/python
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

# A copy of the sources, so that no build folder of an earlier version slips in.
mkdir "$work/source"
cp -r "$root"/{pyproject.toml,README.md,LICENSE,ir_maniskill,ir_maniskill_cli.py,tasks,assets} "$work/source"
"$python" -m pip wheel --quiet --no-deps --no-build-isolation \
    --wheel-dir "$work/dist" "$work/source"
ls -sh "$work/dist"

"$python" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install --quiet --no-deps "$work"/dist/*.whl
"$python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))' \
    >"$work/dependencies"
site=$("$work/venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
mv "$work/dependencies" "$site/dependencies.pth"

cp "$root/scripts/check_install.py" "$work"
cd "$work"
"$work/venv/bin/python" check_install.py "$work/venv"
"$work/venv/bin/ir-maniskill" tasks
