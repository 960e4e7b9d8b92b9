"""Training: PPO, SAC with hindsight and imitation, checkpoints, the loop around."""
