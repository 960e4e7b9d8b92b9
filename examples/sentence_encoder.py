"""Let a sentence encoder of your choice read the instructions.

    pip install sentence-transformers
    python examples/sentence_encoder.py NaoTouchCubeMulti-v1 --steps 20000

Any function from sentences to vectors will do; it stays as it is, and a layer on top of
it is learned. This one downloads its model once. Whoever loads the policy must call the
same `register` before.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Annotated

import torch
import tyro
from torch import Tensor, nn

from ir_maniskill.agent.config import AgentConfig
from ir_maniskill.agent.language_system import LanguageEncoder, register
from ir_maniskill.environment.senses import read_text
from ir_maniskill.training.config import CONFIGS
from ir_maniskill.training.train import train

Embed = Callable[[Sequence[str]], Tensor]
"""Returns a vector for each of M sentences [M, E]."""


def encoder_from(embed: Embed, size: int, width: int = 128) -> type[LanguageEncoder]:
    """Return a language encoder: the vectors [E = size], then a layer that is learned.

    Each sentence is embedded once, however many steps tell it.
    """

    @lru_cache(100_000)
    def embedded(sentence: str) -> Tensor:
        with torch.no_grad():
            return embed([sentence])[0].float().cpu()

    class SentenceEncoder(LanguageEncoder):
        reads = ("text",)

        def __init__(self, config: AgentConfig) -> None:
            super().__init__(config)
            self.width = width
            self.layer = nn.Sequential(nn.Linear(size, width), nn.Tanh())

        def forward(self, text: Tensor) -> Tensor:
            rows = [embedded(sentence) for sentence in read_text(text)]
            return self.layer(torch.stack(rows).to(text.device))

    return SentenceEncoder


def main(
    task: Annotated[str, tyro.conf.Positional] = "NaoTouchCubeMulti-v1",
    steps: int = 250_000,
) -> None:
    """Train with a model of sentence-transformers, and say where the policy is."""
    try:
        from sentence_transformers import SentenceTransformer
    except ImportError:
        raise SystemExit("This needs sentence-transformers: pip install it.") from None
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    model = SentenceTransformer("all-MiniLM-L6-v2")

    def embed(sentences: Sequence[str]) -> Tensor:
        return model.encode(list(sentences), convert_to_tensor=True)

    register("sentences", encoder_from(embed, len(embed(["."])[0])))
    agent = replace(CONFIGS["default"].agent, language="sentences")
    print(f"The best policy is in {train(task, total_steps=steps, agent=agent)}.")


if __name__ == "__main__":
    tyro.cli(main)
