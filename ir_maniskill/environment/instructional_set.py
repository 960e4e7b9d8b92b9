"""Instructional Set: the sentences i_t, their tokens, what they name (Sec. III-A)."""

from __future__ import annotations

import torch
from torch import Tensor

from ir_maniskill.experiment import PAD, Experiment, tokenize


class InstructionalSet:
    """The instructions of one experiment as tensors.

    Attributes:
        sentences: The I sentences.
        tokens: Token ids, padded with 0 to the longest sentence [I, L] int64.
        targets: Index of the object that each sentence names [I] int64.
        named: The same, one-hot [I, C] bool.
    """

    def __init__(self, experiment: Experiment, device: torch.device) -> None:
        """Tokenize the sentences of `experiment` onto `device`."""
        self.sentences = experiment.sentences
        rows = [tokenize(s, experiment.vocabulary) for s in self.sentences]
        length = max(map(len, rows))
        padded = [row + [PAD] * (length - len(row)) for row in rows]
        self.tokens = torch.tensor(padded, device=device)  # [I, L]
        self.targets = torch.tensor(experiment.targets, device=device)  # [I]
        one_hot = torch.eye(len(experiment.objects), dtype=torch.bool, device=device)
        self.named = one_hot[self.targets]  # [I, C]

    def __len__(self) -> int:
        """Return the number of instructions I."""
        return len(self.sentences)

    def pick(self, uniform: Tensor) -> Tensor:
        """Map uniform numbers in [0, 1) to instruction indices [N] int64."""
        return (uniform * len(self)).long().clamp(max=len(self) - 1)
