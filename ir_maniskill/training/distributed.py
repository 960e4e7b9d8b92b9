"""Several processes that train as one, as `torchrun` starts them.

Each process is a *rank* with a vector of envs of its own. The numbers of a config are
those of all ranks together, and gradients, normalizers and figures are those of the
joined batch: the number of ranks changes how fast a training is, not what it does.
Without torchrun there is one rank, for which nothing here changes anything.

Legend: R ranks, B rows of each.
"""

import contextlib
import os
from collections.abc import Callable, Iterator
from datetime import timedelta
from textwrap import shorten
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch import distributed as dist
from torch.nn.utils import parameters_to_vector, vector_to_parameters

T = TypeVar("T")

TIMEOUT = timedelta(minutes=30)
"""How long a rank may keep the others waiting; evaluations are the first rank's."""


class RankError(RuntimeError):
    """Another rank failed, or keeps this one waiting."""


@contextlib.contextmanager
def group(timeout: timedelta = TIMEOUT) -> Iterator[None]:
    """Join the ranks that torchrun tells of, if there are any; leave at the end.

    Raises:
        RankError: If the others do not come.
    """
    if dist.is_initialized() or int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield
        return
    backend = "gloo"
    if torch.cuda.is_available():
        backend = "cpu:gloo,cuda:nccl"
        torch.cuda.set_device(_local_rank())
    with _waiting():
        dist.init_process_group(backend, timeout=timeout)
    try:
        yield
    finally:
        dist.destroy_process_group()


def size() -> int:
    """Return R, the number of ranks."""
    return dist.get_world_size() if dist.is_initialized() else 1


def rank() -> int:
    """Return the number of this rank; rank 0 evaluates and writes."""
    return dist.get_rank() if dist.is_initialized() else 0


def device() -> torch.device:
    """Return where this rank learns: each rank of a machine has a GPU of its own."""
    if not torch.cuda.is_available():
        return torch.device("cpu")
    return torch.device("cuda", _local_rank()) if size() > 1 else torch.device("cuda")


def cores() -> int:
    """Return how many cores this rank may use: the ranks of a machine share them."""
    sharing = int(os.environ.get("LOCAL_WORLD_SIZE", "1")) if size() > 1 else 1
    return max(1, len(os.sched_getaffinity(0)) // sharing)


def gather(values: Tensor) -> Tensor:
    """Return the rows [B, ...] of all ranks as one tensor [R*B, ...]."""
    if size() == 1:
        return values
    values = values.contiguous()
    parts = [torch.empty_like(values) for _ in range(size())]
    with _waiting():
        dist.all_gather(parts, values)
    return torch.cat(parts)


def average_gradients(module: nn.Module) -> None:
    """Replace the gradients by their means over ranks: those of the joined batch."""
    if size() == 1:
        return
    gradients = [w.grad for w in module.parameters() if w.grad is not None]
    flat = parameters_to_vector(gradients)
    with _waiting():
        dist.all_reduce(flat)
    vector_to_parameters(flat / size(), gradients)


def copy_from_first(module: nn.Module) -> None:
    """Give the weights and buffers of the first rank's module to all ranks."""
    if size() > 1:
        with _waiting():
            for tensor in module.state_dict().values():
                dist.broadcast(tensor, 0)


def from_first(make: Callable[[], T]) -> T:
    """Return what the first rank makes; the others wait for it and get a copy."""
    if size() == 1:
        return make()
    box: list[T | None] = [make() if rank() == 0 else None]
    with _waiting():
        dist.broadcast_object_list(box)
    return box[0]  # type: ignore[return-value]


def _local_rank() -> int:
    """Return the number of this rank among those of its machine."""
    return int(os.environ.get("LOCAL_RANK", "0"))


@contextlib.contextmanager
def _waiting() -> Iterator[None]:
    """Say what the errors of torch.distributed mean here."""
    try:
        yield
    except RuntimeError as error:
        number = os.environ.get("RANK", "?")
        raise RankError(
            f"rank {number} lost the others: one of them failed and says why, or keeps "
            f"the rest waiting for too long ({shorten(str(error), 200)})"
        ) from error
