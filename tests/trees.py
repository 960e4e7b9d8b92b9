"""What tests need to look into nested observations."""

import torch


def leaves(tree: dict, path: str = "") -> dict[str, torch.Tensor]:
    """Return all tensors of a nested dict by path."""
    found = {}
    for name, value in tree.items():
        inner = isinstance(value, dict)
        found |= leaves(value, f"{path}{name}/") if inner else {path + name: value}
    return found
