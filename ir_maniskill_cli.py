"""The program `ir-maniskill`, as far as it goes without importing the simulator.

It stands outside the package, whose import registers all tasks and takes seconds: here
the two pages of help that are read most are told at once.
"""

import sys
from collections.abc import Sequence

OVERVIEW = """\
usage: ir-maniskill COMMAND ...

A robot learns to do what a sentence says.

  tasks      list the tasks, and the robots that can do them
  train      train an agent
  evaluate   play seeded episodes, and count
  audit      ask whether a policy looks, reads, and copes with what is new
  video      film a policy (.mp4 or .gif)
  record     keep episodes of a policy as a dataset (ManiSkill, LeRobot)
  talk       open a page to talk to a robot, live
  curve      draw the learning curve of a run (.png, .pdf, .svg)
  bench      measure how fast everything is on this machine
  doctor     say whether this machine can render, and what to install if not

A policy that ships:   ir-maniskill video NaoTouchCubeShuffled-v1
More of a command:     ir-maniskill COMMAND --help
"""

TRAIN = """\
usage: ir-maniskill train [MODULE:]ID [options]

Train an agent. Ctrl-C is safe: --resume goes on from there.

  ID                  task, e.g. NaoTouchCubeSingle-v1 ("ir-maniskill tasks"
                      lists all); for one of your own MODULE registers it

  --preset NAME       which numbers to start from:
                        default   recommended: pictures, joints and touch, dense
                                  reward; 20 minutes on two cores for 3 cubes
                        vision    pictures and the sentence alone
                        listen    many sentences: a teacher, and a policy
                        paper     as published: sparse reward, much slower
  --resume            go on from the folder's last checkpoint, with its config
  --init-from POLICY  begin with the weights of a policy: a task for which one
                      ships, a file, or a run's folder
  --out FOLDER        where checkpoints and figures go (runs/ID)
  --total-steps N     environment steps, over all envs (the preset's)
  --num-envs N        scenes simulated side by side (the preset's)
  --seed N            seed of weights, exploration and scenes (0)
  --robot NAME        nao, g1 or panda (nao)
  --agent.senses A B  what the actor perceives beside the sentence: vision,
                      proprioception, target, touch, state (the preset's)
  --eval-interval N   steps from one evaluation to the next (the preset's)
  --sim-backend NAME  physx_cpu (a process a core), or physx_cuda (the GPU)

  --help-all          all options: rewards, cameras, network, algorithm

  ir-maniskill train NaoTouchCubeTriangle-v1 --seed 1 --out runs/one
  ir-maniskill train NaoTouchCubeTriangle-v1 --resume --out runs/one
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; `ir_maniskill.cli` carries out what is no plea for help."""
    told = sys.argv[1:] if arguments is None else list(arguments)
    helped = bool({"-h", "--help"} & {*told})
    if not told or (helped and told[0].startswith("-")):
        print(OVERVIEW, end="", file=sys.stdout if told else sys.stderr)
        sys.exit(0 if told else 2)
    if helped and told[0] == "train":
        print(TRAIN, end="")
        sys.exit()
    from ir_maniskill import cli

    cli.main(["--help" if word == "--help-all" else word for word in told])


if __name__ == "__main__":
    main()
