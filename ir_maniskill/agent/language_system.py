"""Language System: the sentence i_t becomes G_t."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from ir_maniskill.experiment import PAD


class EncoderLayer(nn.Module):
    """One layer of a transformer encoder: self-attention, then a feed-forward net."""

    def __init__(self, width: int, heads: int) -> None:
        """Make a layer of `width` units shared among `heads`."""
        super().__init__()
        self.heads = heads
        self.queries_keys_values = nn.Linear(width, 3 * width)  # W_Q, W_K, W_V
        self.mix = nn.Linear(width, width)
        self.attention_norm = nn.LayerNorm(width)
        self.feed_forward = nn.Sequential(
            nn.Linear(width, 4 * width), nn.ReLU(), nn.Linear(4 * width, width)
        )
        self.feed_forward_norm = nn.LayerNorm(width)

    def forward(self, tokens: Tensor, attend: Tensor) -> Tensor:
        """Return the tokens [N, L, D], each informed by those it may attend to.

        Softmax(W_Q Q (W_K K)^T / sqrt(d)) W_V V, with Q = K = V = the tokens.
        """
        projected = self.queries_keys_values(tokens)  # [N, L, 3D]
        split = projected.unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        queries, keys, values = split  # [N, heads, L, D/heads] each
        heads = functional.scaled_dot_product_attention(
            queries, keys, values, attn_mask=attend[:, None, None, :]
        )
        tokens = self.attention_norm(
            tokens + self.mix(heads.transpose(1, 2).flatten(2))
        )
        return self.feed_forward_norm(tokens + self.feed_forward(tokens))


class LanguageSystem(nn.Module):
    """G_t = Encoder(i_t): a small transformer over the tokens of the sentence."""

    def __init__(
        self, vocabulary: int, length: int, *, layers: int, heads: int, width: int
    ) -> None:
        """Make the encoder of sentences of up to `length` tokens."""
        super().__init__()
        self.width = length * width
        """Size of G_t: the outputs of all tokens, one after the other."""
        self.words = nn.Embedding(vocabulary, width, padding_idx=PAD)
        self.positions = nn.Parameter(0.1 * torch.randn(length, width))
        self.layers = nn.ModuleList(EncoderLayer(width, heads) for _ in range(layers))

    def forward(self, instruction: Tensor) -> Tensor:
        """Return G_t [N, L*D] of the token ids [N, L].

        A batch repeats few sentences many times, so each is encoded only once.
        """
        sentences, which = torch.unique(instruction, dim=0, return_inverse=True)
        return self._encode(sentences).index_select(0, which)

    def _encode(self, sentences: Tensor) -> Tensor:
        present = sentences != PAD  # [M, L]
        tokens = self.words(sentences) + self.positions  # [M, L, D]
        for layer in self.layers:
            tokens = layer(tokens, present)
        return (tokens * present[..., None]).flatten(1)  # [M, L*D]
