#!/usr/bin/env bash
# Installs PyTorch into a virtual environment: install_torch.sh VENV CONSTRAINTS
#
# TORCH_INDEX (optional) is the address of a package index to take torch from.
# On a machine without an NVIDIA GPU that should be PyTorch's own index of CPU
# wheels: the default wheel for Linux brings several gigabytes of CUDA libraries.
# pip's own configuration (PIP_INDEX_URL, pip.conf) is left as it is.
set -euo pipefail

venv=$1
constraints=$2
options=()

if [ -n "${TORCH_INDEX:-}" ]; then
    options+=(--index-url "$TORCH_INDEX")
elif ! nvidia-smi >/dev/null 2>&1; then
    echo "No NVIDIA GPU here. If the next step downloads CUDA libraries, you may stop it and"
    echo "run again with TORCH_INDEX=<address of PyTorch's index of CPU wheels> (see docs/install.md)."
fi

"$venv/bin/python" -m pip install --constraint "$constraints" "${options[@]}" torch
