"""Image encoders of the ACT student."""

import logging

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature

from lerobot_agpd.cli.export import as_plain
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy
from lerobot_agpd.policies.encoders import GroupNormResNet, SmallEncoder, random_shift

IMAGE = "observation.image"


@pytest.fixture
def make_student(agpd_config, input_features):
    def build(encoder, dataset_meta=None, **options) -> AGPDPolicy:
        image = {IMAGE: PolicyFeature(FeatureType.VISUAL, (3, 40, 40))}
        features = {"observation.state": input_features["observation.state"], **image}
        options = {"pretrained_backbone_weights": None, "use_vae": False, **options}
        config = agpd_config(input_features=features, encoder=encoder, **options)
        return AGPDPolicy(config, dataset_meta=dataset_meta)

    return build


@pytest.fixture
def batch():
    return {
        "observation.state": torch.randn(4, 2),
        IMAGE: torch.rand(4, 3, 40, 40),
        "action": torch.randn(4, 8, 2),
        "action_is_pad": torch.zeros(4, 8, dtype=torch.bool),
    }


@pytest.mark.parametrize("size", [(96, 96), (84, 84), (60, 80)])
def test_an_image_of_any_size_is_one_token(size):
    encoder = SmallEncoder(shift=4)
    features = encoder(torch.rand(2, 3, *size))["feature_map"]
    assert features.shape == (2, encoder.out_channels, 1, 1)


def test_a_shift_moves_the_image_and_repeats_its_border():
    rows = torch.arange(8.0)[:, None].expand(8, 8)
    images = torch.stack([rows, rows.T])[None].expand(200, -1, -1, -1)  # the pixel's row and column
    shifted = random_shift(images, 2)
    top, left = shifted[:, 0, 3, 3] - 3, shifted[:, 1, 3, 3] - 3
    assert {*top.tolist()} == {*left.tolist()} == {-2.0, -1.0, 0.0, 1.0, 2.0}
    expected = (rows[None] + top[:, None, None]).clamp(0, 7)
    assert torch.equal(shifted[:, 0], expected)
    assert torch.equal(random_shift(images, 0), images)


def test_images_are_shifted_in_training_alone():
    encoder, images = SmallEncoder(shift=3), torch.rand(8, 3, 40, 40)
    assert not torch.equal(encoder(images)["feature_map"], encoder(images)["feature_map"])
    encoder.eval()
    assert torch.equal(encoder(images)["feature_map"], encoder(images)["feature_map"])


def test_group_norm_keeps_activations_in_scale():
    encoder = GroupNormResNet("resnet18")
    features = encoder(torch.randn(2, 3, 64, 64) * 20)["feature_map"]
    assert features.shape == (2, encoder.out_channels, 2, 2)
    assert 0.1 < features.std() < 10


@pytest.mark.parametrize("encoder", ["small", "resnet_group_norm"])
def test_a_student_acts_learns_and_comes_back(make_student, batch, tmp_path, encoder):
    student = make_student(encoder, optimizer_lr=3e-4).train()
    student.forward(dict(batch))[0].backward()
    backbone = {id(p): p for p in student.model.backbone.parameters()}
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in backbone.values())
    rates = {id(p): group.get("lr", 3e-4) for group in student.get_optim_params() for p in group["params"]}
    assert {rates[p] for p in backbone} == {3e-4}, "it learns from scratch"
    prior = [student.prior_chunk(batch).chunk for _ in range(2)]
    assert torch.equal(*prior), "what the discriminator sees is not shifted"

    student.save_pretrained(tmp_path / "student")
    loaded = AGPDPolicy.from_pretrained(tmp_path / "student")
    torch.testing.assert_close(loaded.predict_action_chunk(batch), student.predict_action_chunk(batch))
    with pytest.raises(ValueError, match=rf"image encoder '{encoder}'.*--policy.encoder=resnet"):
        as_plain(loaded)


def test_a_small_student_overfits_where_a_dot_is(make_student):
    torch.manual_seed(0)
    places = torch.rand(64, 2)
    images = torch.zeros(64, 3, 40, 40)
    for image, (row, column) in zip(images, (places * 36).long(), strict=True):
        image[:, row : row + 4, column : column + 4] = 1
    chunk = (2 * places - 1)[:, None].expand(-1, 8, -1)
    batch = {"observation.state": torch.zeros(64, 2), IMAGE: images, "action": chunk}
    batch["action_is_pad"] = torch.zeros(64, 8, dtype=torch.bool)
    student = make_student("small", encoder_shift=0, optimizer_lr=1e-3)
    optimizer = torch.optim.AdamW(student.get_optim_params(), lr=1e-3)
    for _ in range(60):
        optimizer.zero_grad()
        student.train().forward(dict(batch))[0].backward()
        optimizer.step()
    error = (student.predict_action_chunk(batch) - chunk).abs().mean()
    assert error < 0.25 * chunk.abs().mean()


@pytest.mark.parametrize(
    ("encoder", "warned"), [("resnet", True), ("resnet_group_norm", False), ("small", False)]
)
def test_an_unnormalized_resnet_is_warned_of(make_student, demonstrations, caplog, encoder, warned):
    with caplog.at_level(logging.WARNING):
        make_student(encoder, demonstrations.meta)
    assert ("not normalized" in caplog.text) == warned
