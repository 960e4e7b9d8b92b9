"""The paper's experiments and ours, one short file each; importing registers them."""

from ir_maniskill.tasks import single, multi, triangle, shuffled, instruct  # noqa: I001

__all__ = ["instruct", "multi", "shuffled", "single", "triangle"]
