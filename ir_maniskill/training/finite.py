"""One error for numbers that stopped being numbers."""

from collections.abc import Mapping

import torch
from torch import Tensor


class TrainingDivergedError(RuntimeError):
    """A NaN or an infinity appeared in training: where, and probably why."""


def not_finite(tensors: Mapping[str, Tensor]) -> list[str]:
    """Return the names of the tensors that have a NaN or an infinity."""
    floats = {k: v for k, v in tensors.items() if v.is_floating_point()}
    # A sum is finite only if its terms are: one cheap pass before looking closer.
    if not floats or torch.stack([v.sum() for v in floats.values()]).isfinite().all():
        return []
    return [name for name, value in floats.items() if not value.isfinite().all()]


def check_finite(tensors: Mapping[str, Tensor], group: str, cause: str) -> None:
    """Raise unless all tensors are finite.

    Args:
        tensors: By name; those of whole numbers are always finite.
        group: What they are, for the message ("gradient", "weight", ...).
        cause: The likely reason, and what to do.

    Raises:
        TrainingDivergedError: Naming the tensors that are not finite.
    """
    if guilty := not_finite(tensors):
        shown = ", ".join(guilty[:5]) + (", ..." if len(guilty) > 5 else "")
        raise TrainingDivergedError(
            f"{group} is no longer finite: {shown}; likely cause: {cause}. The last "
            "checkpoint is intact: change the setting, or resume from it"
        )
