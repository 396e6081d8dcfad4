"""`lerobot-agpd-diversity` on real Push-T rollouts of random policies."""

import json
import sys

import pytest
from lerobot.envs.configs import PushtEnv

from lerobot_agpd.cli import diversity
from lerobot_agpd.flag_checks import FlagError

pytest.importorskip("gym_pusht")


def call(monkeypatch, student, *options: str) -> None:
    flags = ["--env.type=pusht", "--env.obs_type=environment_state_agent_pos", "--env.episode_length=12"]
    flags += [f"--policy.path={student}", "--policy.collect.n_envs=3", "--policy.collect.min_reward=1e-9"]
    monkeypatch.setattr(sys, "argv", ["lerobot-agpd-diversity", *flags, *options])
    diversity.main()


def test_sweep_measures_every_setting(monkeypatch, student, tmp_path):
    output = tmp_path / "sweep"
    options = ["--scales=[2,50]", "--lambdas=[0.5]", "--episodes=3", f"--output={output}"]
    call(monkeypatch, student, *options)
    rows = json.loads((output / "sweep.json").read_text())["rows"]
    settings = [(row["setting"]["strategy"], row["setting"]["strength"]) for row in rows]
    assert settings == [
        ("teacher", 0.0),
        ("guided", 2.0),
        ("guided", 50.0),
        ("interpolate", 0.5),
        ("switch", 0.5),
    ]
    alone, gentle, strong, halfway, _ = (row["actions"] for row in rows)
    assert alone["rms_to_teacher"] == 0 and alone["kl_to_teacher"] == pytest.approx(0, abs=1e-6)
    assert 0 < gentle["rms_to_teacher"] < strong["rms_to_teacher"]
    assert strong["rms_to_student"] < gentle["rms_to_student"] < alone["rms_to_student"]
    assert halfway["rms_to_student"] == pytest.approx(alone["rms_to_student"] / 2, rel=1e-3)
    same_noise = {row["actions"]["rms_teacher_to_student"] for row in rows[:-1]}
    assert len(same_noise) == 1, "the same noise for all but the one that tosses coins"
    assert all(0 <= row["coverage"] <= 1 for row in rows)
    for picture in ("frontier.png", "trajectories.png"):
        assert (output / picture).stat().st_size > 10_000

    again = tmp_path / "again"
    call(monkeypatch, student, *options[:-1], f"--output={again}")
    assert json.loads((again / "sweep.json").read_text())["rows"] == rows, "deterministic"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scales": [0.0]}, "--scales must be positive"),
        ({"lambdas": [1.0]}, "--lambdas must lie between 0 and 1"),
        ({"episodes": 1}, "--episodes must be at least 2"),
        ({"axes": [0]}, "--axes must name two"),
    ],
)
def test_wrong_options_are_refused(monkeypatch, student, tmp_path, options, message):
    monkeypatch.setattr(sys, "argv", ["lerobot-agpd-diversity", f"--policy.path={student}"])
    with pytest.raises(FlagError, match=message):
        diversity.DiversityConfig(env=PushtEnv(), output=tmp_path, **options)
