#!/usr/bin/env bash
# The demonstration: demo.sh IR_MANISKILL TASK FOLDER EPISODES
#
# Trains an agent that perceives nothing but the sentence and what two cameras see (no
# joints, no touch), evaluates it, and leaves a video and a learning curve in FOLDER. A
# run that was interrupted goes on from its last checkpoint; one that is finished is only
# evaluated and filmed again.
set -euo pipefail

ir=$1 task=$2 folder=$3 episodes=$4
best=$folder/best.safetensors
finished=$folder/evaluation.json

if [ -f "$finished" ] && [ -f "$best" ]; then
    echo "A finished run is in $folder (remove it to train anew, or another task)."
else
    echo "Training on $task from camera images (README.md says how long that takes)."
    echo "Ctrl-C is safe: the next 'make demo' goes on from the last checkpoint."
    "$ir" train "$task" --out "$folder" --preset vision --resume
fi

echo
echo "Evaluating on $episodes pinned episodes that training never saw ..."
"$ir" evaluate "$task" --checkpoint "$best" --episodes "$episodes" --json "$folder/report.json"

echo
echo "Filming ..."
"$ir" video "$task" --checkpoint "$best" --out "$folder/video.mp4"
"$ir" curve "$folder" --out "$folder/learning_curve.png"
echo
echo "Look at $folder/video.mp4 and $folder/learning_curve.png; the figures are in"
echo "$folder/report.json."
