import math

import pytest
import torch
from torch import nn

from lerobot_agpd.policies.gradient_norms import GradientNorms


@pytest.fixture
def parameters():
    return [nn.Parameter(torch.ones(2)) for _ in range(3)]


def test_norms_by_hand(parameters):
    a, b, c = parameters
    norms = GradientNorms({"student": [a, b], "discriminator": [c], "representation": []})
    assert norms.pop() == {}
    (3 * a.sum() + 4 * b[0] + c.square().sum()).backward()
    expected = {"grad_norm_student": math.sqrt(9 + 9 + 16), "grad_norm_discriminator": math.sqrt(4 + 4)}
    assert norms.pop() == pytest.approx(expected)
    assert norms.pop() == {}  # every backward pass is told once


def test_a_group_without_gradient_is_not_told(parameters):
    a, _, c = parameters
    norms = GradientNorms({"student": [a], "discriminator": [c]})
    a.sum().backward()
    assert norms.pop() == pytest.approx({"grad_norm_student": math.sqrt(2)})


def test_norms_are_those_before_clipping(parameters):
    a, b, c = parameters
    norms = GradientNorms({"student": [a, b], "discriminator": [c]})
    (100 * a.sum() + b.sum() + c.sum()).backward()
    nn.utils.clip_grad_norm_(parameters, 1.0)
    assert norms.pop()["grad_norm_student"] == pytest.approx(math.sqrt(2 * 100**2 + 2))


def test_a_parameter_used_twice_is_counted_once(parameters):
    a = parameters[0]
    norms = GradientNorms({"student": [a]})
    (a.sum() + 2 * a.sum()).backward()
    assert norms.pop() == pytest.approx({"grad_norm_student": math.sqrt(18)})
