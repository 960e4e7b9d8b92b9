"""The paper's experiments and ours, one short file each; importing registers them."""

from ir_maniskill.tasks import multi, shuffled, single, triangle

__all__ = ["multi", "shuffled", "single", "triangle"]
