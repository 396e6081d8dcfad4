"""The paper's tables: every cell is expanded, and commands are parsed as lerobot-train does."""

from pathlib import Path

import pytest

from lerobot_agpd.plugin import ENV_TYPES
from lerobot_agpd.studies.matrix import load_matrix
from lerobot_agpd.studies.parsing import parse_train_flags
from lerobot_agpd.studies.runs import expand

ROOT = Path(__file__).parents[2]
CELLS = {"table1": 4 * 4, "table2": 12 * 4 + 12, "table3": 8 * 4 + 8, "table4": 2 * 5 + 2}
"""Cells of a table, the teachers' own included."""


@pytest.fixture
def load(tmp_path, monkeypatch):
    """A table's matrix, and its runs with one seed."""
    monkeypatch.setenv("AGPD_RUNS", str(tmp_path))
    monkeypatch.chdir(ROOT)

    def load(name):
        matrix = load_matrix(ROOT / "benchmarks/paper" / f"{name}.yaml")
        runs = expand(matrix, seeds=matrix.seeds[:1])
        return matrix, runs

    return load


@pytest.mark.parametrize("name", CELLS)
def test_every_cell_is_there_once(load, name):
    matrix, runs = load(name)
    assert len(runs) == len({(run.task, run.method) for run in runs}) == CELLS[name]
    assert len(matrix.seeds) == 3 and matrix.evaluation.episodes == 500
    assert matrix.evaluation.curve_episodes == 22


def check_meaning(name, run):
    """What a cell is called is what its command does."""
    config = parse_train_flags(run.args)
    collect, adversary = config.policy.collect, config.policy.adversary
    assert config.env.type in ENV_TYPES and ("pixels" in config.env.obs_type) == run.task.endswith("vision")
    assert (config.dataset.episodes == list(range(20))) == ("few" in run.task)
    assert collect.enabled == (run.method not in ("dp_t", "dp_c", "discriminator"))
    assert (adversary.weight > 0) == (run.method in ("agpd", "discriminator"))
    assert config.policy.denoiser == ("unet" if name == "table1" else "transformer")
    guided = run.method in ("agpd", "guided_pd")
    assert not collect.enabled or (collect.strategy == "guided") == guided
    assert bool(config.policy.teacher.path) == (name != "table1" and run.method != "dp_t")
    assert config.save_checkpoint and not config.policy.push_to_hub


def test_one_command_of_every_table(load):
    for name in CELLS:
        _, runs = load(name)
        check_meaning(name, runs[-2])


@pytest.mark.slow
@pytest.mark.parametrize("name", CELLS)
def test_the_commands_of_every_task_and_every_method(load, name):
    """Not of all their pairs: parsing one takes a second and a half."""
    _, runs = load(name)
    by_cell = {(run.task, run.method): run for run in runs if not run.policy}
    tasks, methods = (list(dict.fromkeys(names)) for names in zip(*by_cell, strict=True))
    for number in range(max(len(tasks), len(methods))):
        check_meaning(name, by_cell[tasks[number % len(tasks)], methods[number % len(methods)]])
