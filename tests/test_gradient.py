"""The gradient of a batch in pieces is the gradient of the batch."""

import pytest
import torch
from torch import nn
from torch.nn import functional

from ir_maniskill.training.gradient import backward


def gradients_in(threads, rows=101):
    torch.manual_seed(0)
    net, unused = nn.Linear(3, 2), nn.Parameter(torch.ones(1))
    x, y = torch.randn(rows, 3), torch.randn(rows, 2)

    def loss(part):
        off = functional.mse_loss(net(x[part]), y[part])
        return off, {"off": off, "sure": off.detach().double() * 0 + 1}

    means = backward(loss, rows, [*net.parameters(), unused], threads)
    assert unused.grad is None
    return means, [weight.grad for weight in net.parameters()]


@pytest.mark.parametrize("threads", [2, 3, 64])
def test_pieces_add_up_to_the_batch(threads):
    (means, gradients), (expected, whole) = gradients_in(threads), gradients_in(1)
    torch.testing.assert_close(gradients, whole)
    torch.testing.assert_close(means, expected)


def test_an_error_in_a_piece_reaches_the_caller():
    with pytest.raises(ZeroDivisionError):
        backward(lambda part: 1 / 0, 64, [torch.ones(1, requires_grad=True)], 2)


@pytest.mark.parametrize("threads", [1, 2])
def test_weights_of_convolutions_go_down_their_own_slope(threads):
    torch.manual_seed(0)
    layer = torch.nn.Conv2d(3, 4, 3)
    maps = torch.randn(64, 6, 6, 3).permute(0, 3, 1, 2)  # in memory, channels are last
    before = layer.weight.detach().clone()
    (slope,) = torch.autograd.grad(layer(maps).square().mean(), [layer.weight])
    backward(
        lambda part: (layer(maps[part]).square().mean(), {}),
        *(len(maps), list(layer.parameters()), threads),
    )
    torch.optim.Adam(layer.parameters(), 0.01, fused=True).step()
    assert torch.equal((layer.weight.detach() - before).sign(), -slope.sign())
