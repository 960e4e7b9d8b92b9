"""Training: roll-outs, PPO, checkpoints and the loop around them."""
