"""Language System: the sentence i_t becomes G_t.

Legend: N envs, L tokens, B bytes, M different sentences, D units of a token, V words.
"""

from __future__ import annotations

from functools import lru_cache
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from ir_maniskill.agent.config import AgentConfig
from ir_maniskill.checks import require
from ir_maniskill.environment.senses import read_text
from ir_maniskill.language.lexicon import Lexicon, lexicon
from ir_maniskill.language.tokens import PAD

LIKE = 32
"""Sentences that are encoded together."""
LAYERS, HEADS, WIDTH = 3, 2, 50
"""Of the paper's transformer: its layers, their heads, and D."""


class LanguageEncoder(nn.Module):
    """Base of what reads sentences; one of your own is a subclass and `register`.

    It returns G_t [N, width] of the entries of the state that it `reads`. All tensors
    that it holds must be in its `state_dict`: a loaded policy has them from the file.
    """

    reads: ClassVar[tuple[str, ...]] = ("instruction",)
    """"instruction" are token ids [N, L], "text" the sentence's bytes [N, B], which
    `environment.senses.read_text` turns into strings."""
    width: int
    """Size of G_t."""

    def __init__(self, config: AgentConfig) -> None:
        """Make what is still untrained; `config` has the words and sizes."""
        super().__init__()


_ENCODERS: dict[str, type[LanguageEncoder]] = {}


def register(name: str, encoder: type[LanguageEncoder]) -> None:
    """Make an encoder known as a value of `AgentConfig.language`.

    Raises:
        ConfigError: Another one has that name, or it is no such class.
    """
    kind = isinstance(encoder, type) and issubclass(encoder, LanguageEncoder)
    require(kind, f"encoder {name!r}", encoder, "a subclass of LanguageEncoder")
    reads, two = encoder.reads, ("instruction", "text")
    fits = isinstance(reads, tuple) and reads != () and set(reads) <= {*two}
    require(fits, f"reads of the encoder {name!r}", reads, f"a tuple of some of {two}")
    free = _ENCODERS.setdefault(name, encoder) is encoder
    require(free, "name of a language encoder", name, "one that is not taken")


def encoder_of(config: AgentConfig) -> type[LanguageEncoder]:
    """Return the encoder that the config names.

    Raises:
        ConfigError: There is none of that name.
    """
    name, known = config.language, ", ".join(map(repr, _ENCODERS))
    require(name in _ENCODERS, "language", name, f"one of {known}")
    return _ENCODERS[name]


class EncoderLayer(nn.Module):
    """One layer of a transformer encoder: self-attention, then a feed-forward net."""

    def __init__(self) -> None:
        """Make an untrained layer."""
        super().__init__()
        self.queries_keys_values = nn.Linear(WIDTH, 3 * WIDTH)  # W_Q, W_K, W_V
        self.mix = nn.Linear(WIDTH, WIDTH)
        self.attention_norm = nn.LayerNorm(WIDTH)
        self.feed_forward = nn.Sequential(
            nn.Linear(WIDTH, 4 * WIDTH), nn.ReLU(), nn.Linear(4 * WIDTH, WIDTH)
        )
        self.feed_forward_norm = nn.LayerNorm(WIDTH)

    def forward(self, tokens: Tensor, attend: Tensor) -> Tensor:
        """Return the tokens [N, L, D], each informed by those it may attend to.

        Softmax(W_Q Q (W_K K)^T / sqrt(d)) W_V V, with Q = K = V = the tokens.
        """
        projected = self.queries_keys_values(tokens)  # [N, L, 3D]
        split = projected.unflatten(-1, (3, HEADS, -1)).permute(2, 0, 3, 1, 4)
        queries, keys, values = split  # [N, heads, L, D/heads] each
        # Of so few tokens, a fused kernel's gradient takes twice as long.
        score = (queries * queries.shape[-1] ** -0.5) @ keys.transpose(-1, -2)
        score = score.masked_fill(~attend[:, None, None, :], -1e4)
        heads = score.softmax(dim=-1).to(values) @ values
        tokens = self.attention_norm(
            tokens + self.mix(heads.transpose(1, 2).flatten(2))
        )
        return self.feed_forward_norm(tokens + self.feed_forward(tokens))


class TokenTransformer(LanguageEncoder):
    """G_t = Encoder(i_t): the paper's small transformer over the tokens.

    G_t has the outputs of all tokens one after the other, as in the paper, and zeros
    for those up to `language_length` that a sentence does not have.
    """

    def __init__(self, config: AgentConfig) -> None:
        """Make the untrained layers."""
        super().__init__(config)
        self.length = config.language_length
        self.width = self.length * WIDTH
        self.words = nn.Embedding(len(config.vocabulary), WIDTH, padding_idx=PAD)
        self.positions = nn.Parameter(0.1 * torch.randn(self.length, WIDTH))
        self.layers = nn.ModuleList(EncoderLayer() for _ in range(LAYERS))

    def forward(self, instruction: Tensor) -> Tensor:
        """Return G_t [N, width] of the token ids [N, L].

        A batch repeats few sentences many times, so each is encoded only once; many
        are encoded with others of like length, since padding takes as long as words.

        Raises:
            ValueError: A sentence is too long, or has ids that no word has.
        """
        sentences, which = torch.unique(instruction, dim=0, return_inverse=True)
        order = (sentences != PAD).sum(dim=1).argsort()
        parts = sentences[order].tensor_split(max(1, len(order) // LIKE))
        encoded = torch.cat([self._encode(self._fitting(part)) for part in parts])
        return encoded.index_select(0, order.argsort()[which])

    def _fitting(self, sentences: Tensor) -> Tensor:
        """Return the sentences [M, L] without the padding that all of them have."""
        places = (sentences != PAD).any(dim=0).nonzero()
        longest = int(places.max()) + 1 if len(places) else 1
        _require_length(longest, self.length)
        return sentences[:, :longest]

    def _embed(self, sentences: Tensor) -> Tensor:
        """Return the embeddings [M, L, D] of token ids [M, L]."""
        words = self.words.num_embeddings
        if sentences.numel() and sentences.max() >= words:
            raise ValueError(
                f"instruction: got the token id {int(sentences.max())}, expected one "
                f"of the {words} that this agent learned; its task has other words"
            )
        return self.words(sentences)

    def _encode(self, sentences: Tensor) -> Tensor:
        present = sentences != PAD  # [M, L]
        tokens = self._embed(sentences) + self.positions[: sentences.shape[1]]
        for layer in self.layers:
            tokens = layer(tokens, present)  # [M, L, D]
        flat = tokens.masked_fill(~present[..., None], 0).flatten(1)
        return functional.pad(flat, (0, self.width - flat.shape[1]))


def _require_length(length: int, longest: int) -> None:
    if length > longest:
        raise ValueError(
            f"instruction: got a sentence of {length} tokens, expected at most "
            f"{longest}; say it in fewer words, or train an agent with a larger "
            "language_length, as the preset 'listen' has"
        )


class LexiconTransformer(TokenTransformer):
    """The same over the text: a word that it never learned is read as others.

    Its embedding is the mixture of theirs that `Lexicon` gives. Sentences of known
    words are read as `TokenTransformer` reads them, with the same weights.
    """

    reads = ("text",)

    def __init__(self, config: AgentConfig) -> None:
        """Make the untrained layers."""
        super().__init__(config)
        self.vocabulary = config.vocabulary
        lexicon(self.vocabulary)  # before threads ask for it, each to make its own

    def forward(self, text: Tensor) -> Tensor:
        """Return G_t [N, width] of the sentences' bytes [N, B].

        Raises:
            ValueError: A sentence is too long.
        """
        known = lexicon(self.vocabulary)
        rows = b"".join(_ids(known, said, self.length) for said in read_text(text))
        ids = np.frombuffer(rows, np.int64).reshape(len(text), self.length)
        return super().forward(torch.tensor(ids, device=text.device))

    def _embed(self, sentences: Tensor) -> Tensor:
        words, mixtures = self.words.weight, lexicon(self.vocabulary).mixtures
        shares = torch.tensor(mixtures, dtype=words.dtype, device=words.device)
        every = torch.cat([words, shares @ words])  # [V + mixtures, D]
        return functional.embedding(sentences, every, padding_idx=PAD)


@lru_cache(100_000)
def _ids(known: Lexicon, sentence: str, length: int) -> bytes:
    """Return the ids of a sentence [L] int64, padded to a length, as bytes."""
    ids = known.ids(sentence)
    _require_length(len(ids), length)
    return np.array(ids + [PAD] * (length - len(ids)), np.int64).tobytes()


register("tokens", TokenTransformer)
register("lexicon", LexiconTransformer)
