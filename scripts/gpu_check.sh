#!/usr/bin/env bash
# What works on this machine's GPU, in less than ten minutes: gpu_check.sh VENV [FOLDER]
#
# Parts whose means are absent are skipped and say what is missing. Each part's output is
# in FOLDER (runs/gpu_check); the exit code is 1 if one failed. None of it was run on a
# GPU by those who wrote it: please send FOLDER/summary.txt if a part fails.
set -uo pipefail

bin=$(realpath "${1:?usage: gpu_check.sh VENV [FOLDER]}")/bin folder=${2:-runs/gpu_check}
[ -x "$bin/ir-maniskill" ] || { echo "$bin has no ir-maniskill: make setup first" && exit 2; }
mkdir -p "$folder"
: >"$folder/summary.txt"
root=$(realpath "$(dirname "$0")/..")
failed=0

say() { echo "$*" | tee -a "$folder/summary.txt"; }

part() { # NAME SECONDS COMMAND...: run it, and say how it went
    local name=$1 limit=$2 log="$folder/${1// /_}.txt" code=0 start=$SECONDS
    shift 2
    timeout --kill-after 10 "$limit" "$@" >"$log" 2>&1 || code=$?
    local last
    last=$(grep -v '^ *$' "$log" | tail -n 1)
    case $code in
        0) say "ok       $name, $((SECONDS - start)) s: $last" ;;
        124) say "FAILED   $name: took more than $limit s; see $log" && failed=1 ;;
        *) say "FAILED   $name: $last; see $log" && failed=1 ;;
    esac
}

cat >"$folder/step.py" <<'PYTHON'
"""Random steps of a vector of envs: step.py ID NUM_ENVS OPTION=VALUE..."""
import sys
import time

import torch

import ir_maniskill


def main(task, count, *options):
    kwargs = dict(option.split("=") for option in options)
    if kwargs["obs_mode"] == "rgb":
        kwargs["sensor_configs"] = dict(width=32, height=64, shader_pack="unlit")
    envs = ir_maniskill.make_vec(task, int(count), **kwargs)
    envs.reset(seed=0)
    touched = False
    for step in range(80):
        if step == 16:  # what is compiled or made at first does not count
            start = time.perf_counter()
        obs, reward, *_, info = envs.step(2 * torch.rand(envs.action_space.shape) - 1)
        assert reward.isfinite().all(), f"step {step}: got rewards that are not finite"
        touched |= bool(info["contact"].any())
    took = time.perf_counter() - start
    assert touched, "no finger ever touched anything"
    envs.close()
    print(f"{64 * int(count) / took:.0f} steps/s of {count} envs")


if __name__ == "__main__":
    main(*sys.argv[1:])
PYTHON
step=("$bin/python" "$folder/step.py")

cuda=$("$bin/python" -c 'import torch; print(*map(torch.cuda.get_device_name, range(torch.cuda.device_count())))')
physx=$(ls "$HOME"/.sapien/physx/*/libPhysXGpu_64.so 2>/dev/null | tail -n 1)
say "GPU: ${cuda:-none that torch finds}; driver: $(nvidia-smi --query-gpu=driver_version --format=csv,noheader 2>/dev/null || echo 'no nvidia-smi')"

part doctor 60 "$bin/python" -I "$root/ir_maniskill/doctor.py"
if [ -z "$cuda" ]; then
    say "skipped  physics on the GPU, drawing on the GPU: torch finds no CUDA device"
else
    if [ -z "$physx" ]; then
        say "skipped  physics on the GPU: no $HOME/.sapien/physx/*/libPhysXGpu_64.so, which SAPIEN fetches when it first needs it"
    else
        options=(sim_backend=physx_cuda render_backend=none obs_mode=state_dict)
        part "physics on the GPU" 90 "${step[@]}" NaoTouchCubeTriangle-v1 1024 "${options[@]}"
        part "drawn objects on the GPU" 90 "${step[@]}" NaoInstruct-v1 256 "${options[@]}"
    fi
    part "drawing on the GPU" 60 "${step[@]}" NaoInstruct-v1 16 sim_backend=physx_cpu render_backend=gpu obs_mode=rgb
fi
part "drawing on the cores" 60 "${step[@]}" NaoInstruct-v1 16 sim_backend=physx_cpu render_backend=cpu obs_mode=rgb
part training 120 "$bin/ir-maniskill" train NaoTouchCubeSingle-v1 --out "$folder/run" --total-steps 4096 --eval-episodes 3
part benchmark 90 "$bin/ir-maniskill" bench --quick --json "$folder/bench.json"
exit $failed
