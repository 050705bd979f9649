"""The U-Net: shapes, and pinned ends that stay as they are."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cdiff_cli.models.networks import SinusoidalStep, TemporalUnet


@pytest.fixture(scope="module")
def net() -> TemporalUnet:
    return make(width=8, multipliers=(1, 2, 4))


def make(**size) -> TemporalUnet:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return TemporalUnet(4, **size).requires_grad_(False)


def noise(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def test_step_embedding_of_zero_is_sines_0_and_cosines_1():
    assert SinusoidalStep(8)(torch.zeros(1)).tolist() == [[0, 0, 0, 0, 1, 1, 1, 1]]


def test_step_embedding_starts_with_the_plain_angle():
    t = torch.tensor([1.0, 2.0])
    embedded = SinusoidalStep(8)(t)
    assert torch.allclose(embedded[:, 0], t.sin())
    assert torch.allclose(embedded[:, 4], t.cos())


@pytest.mark.parametrize(
    ("horizon", "multipliers"),
    [(128, (1, 2, 4)), (384, (1, 2, 2, 4, 4)), (384, (1, 4, 8)), (8, (1,))],
)
def test_output_has_the_shape_of_the_input_and_its_pinned_ends(horizon, multipliers):
    unet = make(width=8, multipliers=multipliers)
    assert horizon % unet.stride == 0
    x = noise(0, 2, horizon, 4)
    estimate = unet(x, torch.tensor([1.0, 7.0]))
    assert estimate.shape == (2, horizon, 4)
    assert torch.equal(estimate[:, [0, -1]], x[:, [0, -1]])


def test_stride_is_two_to_the_number_of_levels_less_one():
    assert [make(width=8, multipliers=(1,) * levels).stride for levels in (1, 2, 3)] == [1, 2, 4]


@settings(max_examples=10, deadline=None)
@given(
    seed=st.integers(0, 1000),
    batch=st.integers(1, 3),
    horizon=st.sampled_from([4, 8, 32]),
    t=st.integers(1, 256),
)
def test_pinned_ends_come_back_exactly(net, seed, batch, horizon, t):
    x = noise(seed, batch, horizon, 4)
    estimate = net(x, torch.full((batch,), float(t)))
    assert torch.equal(estimate[:, 0], x[:, 0])
    assert torch.equal(estimate[:, -1], x[:, -1])
    assert not torch.equal(estimate[:, 1], x[:, 1])


@pytest.mark.parametrize("ends", [(0,), (-1,), ()])
def test_only_the_named_ends_are_pinned(ends):
    unet = make(width=8, multipliers=(1, 2), ends=ends)
    x = noise(1, 1, 16, 4)
    estimate = unet(x, torch.ones(1))
    assert torch.equal(estimate[:, 0], x[:, 0]) == (0 in ends)
    assert torch.equal(estimate[:, -1], x[:, -1]) == (-1 in ends)


def test_share_of_the_pinned_state_falls_linearly_to_zero_within_the_ramp(net):
    share = net._share(0, noise(0, 1, 128, 4))[:, 0]
    assert torch.allclose(share[:17], 1 - torch.arange(17) / 16)
    assert share[17:].abs().max() == 0
    assert torch.equal(net._share(-1, noise(0, 1, 128, 4))[:, 0], share.flip(0))


def test_ramps_of_a_short_horizon_do_not_overlap(net):
    x = noise(0, 1, 8, 4)
    assert (net._share(0, x) * net._share(-1, x)).abs().max() == 0


def test_every_waypoint_depends_on_the_pinned_state(net):
    x = noise(2, 1, 128, 4)
    moved = x.clone()
    moved[:, -1] += 1.0
    assert (net(x, torch.ones(1)) != net(moved, torch.ones(1))).any(-1)[0, 1:].all()


def test_trajectories_of_a_batch_do_not_affect_each_other(net):
    x, t = noise(3, 3, 32, 4), torch.tensor([1.0, 9.0, 40.0])
    alone = torch.cat([net(x[i : i + 1], t[i : i + 1]) for i in range(3)])
    assert torch.allclose(net(x, t), alone, atol=1e-5)  # float32, sums in another order


def test_every_parameter_gets_a_gradient():
    unet = make(width=8, multipliers=(1, 2)).requires_grad_(True)
    unet(noise(4, 2, 16, 4), torch.tensor([1.0, 5.0])).square().sum().backward()
    assert [
        name for name, p in unet.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0
    ] == []
