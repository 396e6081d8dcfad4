"""Types of third-party packages, found in LeRobot's own two ways: `discover_packages_path` and installation."""

import json
import shutil
from pathlib import Path

import draccus
import pytest
from commands import (
    PLUGINS,
    TINY_STUDENT,
    TINY_TEACHER,
    dataset_flags,
    last_checkpoint,
    records,
    reports,
    run,
    run_here,
)
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.envs import EnvConfig
from point import make_demonstrations

from lerobot_agpd.loading import read_policy_config

ROUND = [
    "--policy.collect.warmup=1",
    "--policy.collect.rounds=1",
    "--policy.collect.episodes=4",
    "--policy.adversary.start=1",
    "--steps=3",
]


def install(package: str, folder: Path) -> Path:
    """A folder of installed packages with one of ours."""
    site = folder / "site-packages"
    shutil.copytree(PLUGINS / package, site / package)
    metadata = site / f"{package}-0.1.0.dist-info" / "METADATA"
    metadata.parent.mkdir()
    metadata.write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 0.1.0\n")
    return site


@pytest.fixture(scope="module")
def demos(tmp_path_factory) -> Path:
    return make_demonstrations(tmp_path_factory.mktemp("point") / "demos")


@pytest.fixture(scope="module")
def teacher(demos: Path, tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("point") / "teacher"
    run_here("lerobot-train", *TINY_TEACHER, *dataset_flags(demos), "--steps=150", f"--output_dir={output}")
    return last_checkpoint(output)


def check(output: Path) -> None:
    """The round was collected in the plugin's environment, and episodes were kept."""
    (report,) = reports(output)
    assert report["total"]["generated"] == 4 and report["total"]["kept"] > 0
    assert all(record["length"] <= 12 for record in records(output, 0))
    journal = json.loads((output / "agpd" / "journal.json").read_text())
    assert journal["identity"]["environment"] == {"type": "point", "task": "Point-v0"}


@pytest.mark.slow
def test_a_package_named_on_the_command_line(
    demos: Path, teacher: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(PLUGINS)
    output = tmp_path / "run"
    run(
        "lerobot-train",
        *TINY_STUDENT,
        *ROUND,
        *dataset_flags(demos),
        f"--policy.teacher.path={teacher}",
        "--env.discover_packages_path=lerobot_env_point",
        "--env.type=point",
        f"--output_dir={output}",
    )
    check(output)


@pytest.mark.slow
def test_an_installed_environment(
    demos: Path, teacher: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Named for the collection alone; the checkpoint then loads where the plugin is not known."""
    monkeypatch.syspath_prepend(install("lerobot_env_point", tmp_path))
    output = tmp_path / "run"
    run(
        "lerobot-train",
        *TINY_STUDENT,
        *ROUND,
        *dataset_flags(demos),
        f"--policy.teacher.path={teacher}",
        "--policy.collect.env.type=point",
        f"--output_dir={output}",
    )
    check(output)
    assert "point" not in EnvConfig.get_known_choices()
    assert PreTrainedConfig.from_pretrained(last_checkpoint(output)).type == "agpd"


def test_an_installed_teacher_without_a_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """LeRobot's commands import installed plugins; a program that calls `train` need not have done so."""
    monkeypatch.syspath_prepend(install("lerobot_policy_stub", tmp_path))
    teacher = tmp_path / "teacher"
    teacher.mkdir()
    (teacher / "config.json").write_text(json.dumps({"type": "stub", "device": "cpu"}))
    assert read_policy_config(teacher, "--policy.teacher.path").type == "stub"


@pytest.mark.parametrize(
    "flags",
    [
        ("--env.type=pusht", "--env.obs_type=environment_state_agent_pos", "--env.render_mode=human"),
        ("--env.type=aloha_state", "--env.obs_type=pixels_environment_state_agent_pos"),
        ("--env.type=gymnasium_robotics", "--env.obs_type=state"),
        ("--policy.type=multi_task_dit", "--policy.prediction_type=epsilon"),
    ],
    ids=lambda flags: flags[0],
)
def test_types_with_flags_of_the_same_name(flags: tuple[str, ...]) -> None:
    """draccus holds a flag to the choices of the type that was registered last, whatever type is selected."""
    config = draccus.parse(TrainPipelineConfig, args=["--dataset.repo_id=local/test", *flags])
    _, *values = (flag.removeprefix("--").split("=") for flag in flags)
    for name, value in values:
        group, field = name.split(".")
        assert getattr(getattr(config, group), field) == value
