"""The learner, one file for each of the paper's boxes.

The sentence goes through the Language System, images and body senses through the
Perceptual System; Alignment joins them, Actor and Critic read the result.
"""

from ir_maniskill.agent.agent import Agent, StateSpec

__all__ = ["Agent", "StateSpec"]
