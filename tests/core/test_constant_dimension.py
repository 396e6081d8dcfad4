"""Demonstrations in which one action dimension never varies, and a teacher that uses it."""

import logging

import pytest
import torch
from lerobot.configs import NormalizationMode
from small_dataset import make_dataset

from lerobot_agpd.config import AdversaryConfig, CollectConfig, ReplayConfig, TeacherConfig
from lerobot_agpd.replay.normalization import floor_statistics, training_statistics

OPEN = 1.0


@pytest.fixture(scope="module")
def constant(tmp_path_factory):
    return make_dataset(tmp_path_factory.mktemp("data") / "constant", gripper=OPEN)


@pytest.fixture
def config(agpd_config, save_teacher):
    """A student that imitates the chunks of a teacher whose data vary in both dimensions."""

    def build(**options):
        return agpd_config(
            **{
                "teacher": save_teacher(),
                "collect": CollectConfig(every=0),
                "replay": ReplayConfig(relabel="all"),
                "adversary": AdversaryConfig(start=0),
                **options,
            }
        )

    return build


@pytest.mark.parametrize("mode", ["MEAN_STD", "MIN_MAX", "QUANTILES"])
def test_a_constant_action_dimension_costs_no_more_than_one_that_varies(
    build, config, constant, demonstrations, loop_batch, caplog, mode
):
    caplog.set_level(logging.WARNING)
    losses, chunks = [], []
    mapping = {kind: NormalizationMode("MEAN_STD") for kind in ("STATE", "ENV")}
    mapping["ACTION"] = NormalizationMode(mode)
    for dataset in (demonstrations, constant):
        torch.manual_seed(0)
        policy = build(config(normalization_mapping=mapping), dataset=dataset)
        batch = loop_batch(policy.config, range(13), dataset)
        _, log = policy.forward(batch)
        losses.append(log["imitation_loss"])
        chunks.append(policy.agpd.teacher_chunks.at(torch.arange(13))[0].abs().max())
        assert log["discriminator_loss"] < 50
    assert 0.3 < losses[1] / losses[0] < 3, losses  # 300 to 2000 where the dimension is divided by the floor
    assert chunks[1] < 10, chunks
    assert "normalized units" not in caplog.text


def test_values_that_no_statistics_prepare_for_are_warned_of(
    build, config, constant, loop_batch, caplog, monkeypatch
):
    """As where the teacher's own statistics are not known."""
    monkeypatch.setattr("lerobot_agpd.replay.normalization._teacher_statistics", lambda path: {})
    policy = build(config(), dataset=constant)
    policy.forward(loop_batch(policy.config, range(13), constant))
    (warning,) = [r.getMessage() for r in caplog.records if "normalized units" in r.getMessage()]
    assert "dimension 1 of 'action'" in warning


def test_a_dimension_that_neither_side_uses_stays_floored(agpd_config, save_policy, save_teacher, constant):
    teacher = {"mean": torch.tensor([5.0, OPEN]), "std": torch.tensor([2.0, 0.0])}
    teacher |= {"min": torch.tensor([0.0, OPEN]), "max": torch.tensor([9.0, OPEN])}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lerobot_agpd.replay.normalization._teacher_statistics", lambda _: {"action": teacher})
        trained = training_statistics(agpd_config(teacher=TeacherConfig(path="x")), constant.meta.stats)
    floored = floor_statistics(constant.meta.stats)
    for name in ("mean", "std", "min", "max"):
        assert torch.equal(torch.as_tensor(trained["action"][name]), torch.as_tensor(floored["action"][name]))


def test_scaling_by_hand(agpd_config, constant, monkeypatch):
    teacher = {"mean": torch.tensor([5.0, 0.7]), "std": torch.tensor([2.0, 0.4])}
    teacher |= {"min": torch.tensor([0.0, -1.0]), "max": torch.tensor([9.0, 0.9])}
    monkeypatch.setattr(
        "lerobot_agpd.replay.normalization._teacher_statistics", lambda _: {"action": teacher}
    )
    original = constant.meta.stats["action"]
    trained = training_statistics(agpd_config(teacher=TeacherConfig(path="x")), constant.meta.stats)["action"]
    assert float(trained["std"][1]) == pytest.approx(0.5)  # 0.4 around 0.7, seen from 1.0
    assert trained["mean"][1] == OPEN
    assert (float(trained["min"][1]), float(trained["max"][1])) == (-1.0, OPEN)
    for name in ("mean", "std", "min", "max", "q01", "q99"):
        assert float(trained[name][0]) == float(original[name][0]), "a dimension that varies stays as it is"
    assert float(trained["q01"][1]) == -1.0, "narrow quantiles become the whole range"


def test_without_a_teacher_nothing_changes(agpd_config, constant):
    trained = training_statistics(agpd_config(), constant.meta.stats)["action"]
    assert float(trained["std"][1]) == pytest.approx(1e-3)
