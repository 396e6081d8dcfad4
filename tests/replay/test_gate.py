"""What may enter T: rows of NaN, statistics, and values on another scale."""

import logging

import numpy as np
import pytest
import torch

from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.replay.frames import FrameTable
from lerobot_agpd.replay.gate import (
    FarValues,
    first_not_finite,
    require_finite_frames,
    require_statistics,
)

STATE, ENV_STATE = "observation.state", "observation.environment_state"


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("key", [STATE, ENV_STATE, "action"])
def test_one_nan_in_a_state_or_an_action(key, value):
    """Named by feature, episode and frame in the episode, with the number of frames concerned."""
    columns = {name: torch.zeros(10, 2) for name in (STATE, ENV_STATE, "action")}
    table = FrameTable(columns, [4, 6])
    require_finite_frames(table, "local/x")
    columns[key][7, 1] = columns[key][9, 0] = value
    with pytest.raises(FlagError, match=rf"--dataset.repo_id=local/x.*'{key}'.*episode 1, frame 3 .*2 of 10"):
        require_finite_frames(FrameTable(columns, [4, 6]), "local/x")


@pytest.mark.parametrize("name", ["mean", "std", "min", "q99"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_statistics_that_are_not_finite(agpd_config, demonstrations, name, value):
    stats = {key: dict(entry) for key, entry in demonstrations.meta.stats.items()}
    keys = ["action", STATE, ENV_STATE]
    require_statistics(stats, agpd_config(), keys, "local/x")
    stats["timestamp"] = {"mean": np.array([np.nan])}  # no feature of the policy
    require_statistics(stats, agpd_config(), keys, "local/x")
    stats[ENV_STATE][name] = np.array([0.0, 1.0, value])
    with pytest.raises(FlagError, match=rf"'{name}' of '{ENV_STATE}'.*recompute_stats"):
        require_statistics(stats, agpd_config(), keys, "local/x")


def test_stats_json_missing(agpd_config, demonstrations):
    for stats in (None, {}, {"action": demonstrations.meta.stats["action"]}):
        with pytest.raises(FlagError, match=rf"local/x has no statistics.*{STATE}.*recompute_stats"):
            require_statistics(stats, agpd_config(), ["action", STATE], "local/x")
    as_they_are = agpd_config(normalization_mapping={})
    require_statistics(None, as_they_are, ["action", STATE], "local/x")


def test_the_first_value_of_an_episode_that_is_not_finite():
    columns = {
        "a": np.zeros((5, 2), np.float32),
        "b": np.zeros(5, np.float32),
        "c": np.zeros((5, 2, 2, 3), np.uint8),
    }
    assert first_not_finite(columns) is None
    columns["a"][3, 1], columns["b"][2] = np.nan, -np.inf
    assert first_not_finite(columns) == "'b' at step 2"


def test_values_that_are_far_off_are_warned_of(caplog):
    caplog.set_level(logging.WARNING)
    far = FarValues()
    far.check("round 1", "action", torch.full((4, 3, 2), 49.0))
    far.check("round 1", "action", torch.zeros(0, 2))
    assert not caplog.records
    values = torch.zeros(4, 3, 2)
    values[2, 1, 1] = -2000
    for _ in range(2):
        far.check("round 1", "action", values)
    (record,) = caplog.records
    assert "round 1: dimension 1 of 'action'" in record.getMessage() and "2000" in record.getMessage()
