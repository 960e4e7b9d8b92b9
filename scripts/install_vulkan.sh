#!/usr/bin/env bash
# Makes sure that SAPIEN can render here: install_vulkan.sh VENV
#
# Asks the doctor first and does nothing where rendering works. Otherwise it runs the
# commands that the doctor prescribes (system packages, above all Mesa's software Vulkan
# driver), as root or through passwordless sudo. Where it lacks the rights it prints them
# and fails.
set -euo pipefail
cd "$(dirname "$0")/.."

doctor() {
    "$venv/bin/python" -I ir_maniskill/doctor.py "$@"
}

venv=$1
if doctor; then
    exit 0
fi

commands=$(doctor --commands || true)
if [ -z "$commands" ]; then
    exit 1
fi
if [ "$(id -u)" -ne 0 ] && ! sudo -n true 2>/dev/null; then
    echo >&2
    echo "This user may not install system packages: run the commands above, then make again." >&2
    exit 1
fi

echo "Installing the system packages that rendering needs ..."
DEBIAN_FRONTEND=noninteractive bash -euo pipefail -c "$commands"
doctor
