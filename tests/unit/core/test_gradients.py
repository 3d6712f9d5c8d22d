"""What parts of a training pass back."""

import torch

from scene_experts.core.gradients import Regularisers, ReusedGradients, allocate


def test_a_term_that_is_not_named_is_off():
    assert not any(vars(Regularisers()).values())


def test_parts_of_an_array_lie_apart():
    whole, (a, b, c, d) = allocate(torch.ones(1, dtype=torch.float64), [(3, 5), (2, 1), (0, 4), ()])
    assert [t.shape for t in (a, b, c, d)] == [(3, 5), (2, 1), (0, 4), ()] and whole.dtype == torch.float64
    a.fill_(1.0), b.fill_(2.0), d.fill_(4.0)
    assert whole.sum() == 15 + 4 + 4 and all(t.is_contiguous() for t in (a, b, c, d))
    assert [t.storage_offset() for t in (a, b, d)] == [0, 16, 32]


def test_the_gradients_of_the_views_of_a_batch_add_up():
    parameter, gradient = torch.nn.Parameter(torch.zeros(3)), torch.zeros(3)
    reused = ReusedGradients([(parameter, gradient)])
    for view in range(3):
        reused.release()
        gradient.fill_(10.0**view)
        reused.add()
    assert parameter.grad.tolist() == [111.0] * 3
    parameter.grad = None  # a new batch
    reused.add()
    assert parameter.grad is gradient
