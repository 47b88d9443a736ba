"""MPNet: sizes, dropout that stays on, weights on disk."""

import pytest
import torch

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.vqmpt.config import MPNetConfig
from cvqmpt_lab.vqmpt.mpnet import MPNet, dropout
from cvqmpt_lab.vqmpt.weights import RobotSignature

SMALL = MPNetConfig(n_points=10, encoder_widths=(8, 6), code_dim=4, planner_widths=(16, 12, 8))
ROBOT = RobotSignature("arm", (-1.0,) * 7, (1.0,) * 7)


@pytest.fixture
def network():
    torch.manual_seed(0)
    return MPNet(SMALL).eval()


def queries(count=3):
    generator = torch.Generator().manual_seed(1)
    shapes = ((count, 7), (count, 7), (count, 4))
    return [2.0 * torch.rand(shape, generator=generator) - 1.0 for shape in shapes]


def test_forward_is_a_chain_of_linear_and_prelu(network):
    current, goal, code = queries()
    x = torch.cat((code, current, goal), 1)
    for linear, prelu in network.hidden:
        x = x @ linear.weight.T + linear.bias
        x = torch.where(x > 0, x, prelu.weight * x)
    expected = x @ network.out.weight.T + network.out.bias
    torch.testing.assert_close(network(current, goal, code, stochastic=False), expected)
    assert network.encode(torch.rand(3, 10, 3)).shape == (3, 4)
    with pytest.raises(InvalidInputError, match=r"this network takes \(10, 3\)"):
        network.encode(torch.rand(3, 9, 3))
    network(current, goal, network.encode(torch.rand(3, 10, 3))).square().sum().backward()
    assert not [name for name, p in network.named_parameters() if p.grad is None]


def test_dropout_stays_on_and_repeats_by_seed(network):
    ends = queries()
    first, same, other = (network(*ends, generator=torch.Generator().manual_seed(seed)) for seed in (0, 0, 1))
    torch.testing.assert_close(first, same)
    assert not torch.equal(first, other)
    dropped = dropout(torch.ones(200, 200), 0.5, torch.Generator().manual_seed(0))
    assert set(dropped.unique().tolist()) == {0.0, 2.0}
    assert float(dropped.mean()) == pytest.approx(1.0, abs=0.02)
