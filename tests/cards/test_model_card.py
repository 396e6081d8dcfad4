"""Model cards: written with checkpoints, pushed with them, completed by evaluations."""

import json

import pytest
from huggingface_hub import ModelCard
from lerobot.envs.configs import PushtEnv

from lerobot_agpd.cards import install
from lerobot_agpd.cards.model_card import EXTRAS, ModelFacts, add_results, environment_flags, model_card
from lerobot_agpd.plugin import ENV_TYPES


def facts(**changed) -> ModelFacts:
    values = {"summary": "A policy.", "facts": {"teacher": "`t`"}, "dataset": "somebody/demos"}
    return ModelFacts(**{**values, **changed})


def test_the_head_names_the_dataset_the_teacher_and_the_license(agpd_config):
    config = agpd_config(repo_id="me/student", tags=["mine"], license="mit")
    card = model_card(config, facts(base_model="somebody/teacher"))
    head = card.data.to_dict()
    assert head["datasets"] == "somebody/demos" and head["base_model"] == "somebody/teacher"
    assert head["license"] == "mit" and {"mine", "agpd", "robotics", "lerobot"} <= set(head["tags"])
    assert "# student" in card.text and "| teacher | `t` |" in card.text


def test_what_is_on_no_hub_is_no_metadata(agpd_config):
    head = model_card(agpd_config(), facts(dataset="local/demos")).data.to_dict()
    assert "datasets" not in head and "base_model" not in head


def test_the_evaluation_command_selects_the_environment(agpd_config):
    env = PushtEnv(obs_type="environment_state_agent_pos")
    flags = environment_flags(env)
    assert flags == [
        "--env.type=pusht",
        "--env.task=PushT-v0",
        "--env.obs_type=environment_state_agent_pos",
    ]
    card = model_card(agpd_config(repo_id="me/student"), facts(env=env))
    assert "lerobot-eval --policy.path=me/student " + " ".join(flags) in card.text
    assert "lerobot_policy_agpd[pusht] @ git+" in card.text


def test_every_environment_of_the_plugin_names_the_extra_that_installs_it():
    assert set(ENV_TYPES) <= set(EXTRAS)


def test_a_later_evaluation_replaces_the_earlier_one(agpd_config, tmp_path):
    model_card(agpd_config(), facts()).save(tmp_path / "README.md")
    for rate in (0.25, 0.5):
        assert add_results(tmp_path, f"success {rate}", {"type": "pusht", "task": "PushT-v0"}, rate, 8)
    card = ModelCard.load(tmp_path / "README.md")
    assert "success 0.5" in card.text and "success 0.25" not in card.text
    (result,) = card.data.eval_results
    assert (result.metric_value, result.dataset_name) == (0.5, "PushT-v0")


def test_other_readmes_are_left_alone(tmp_path):
    assert not add_results(tmp_path, "", {"type": "pusht"}, 1.0, 8)
    (tmp_path / "README.md").write_text("Somebody else's.")
    assert not add_results(tmp_path, "", {"type": "pusht"}, 1.0, 8)
    assert (tmp_path / "README.md").read_text() == "Somebody else's."


@pytest.mark.parametrize(
    ("origin", "expected"),
    [
        ({"url": "https://h.org/a", "vcs_info": {"commit_id": "abc"}}, "git+https://h.org/a@abc"),
        ({"url": "file:///home/me"}, f"git+{install.UNKNOWN}"),
    ],
)
def test_the_installation_names_what_is_installed_here(monkeypatch, tmp_path, origin, expected):
    found = tmp_path / "lerobot_policy_agpd-1.dist-info"
    found.mkdir()
    (found / "METADATA").write_text("Name: lerobot_policy_agpd\nVersion: 1\n")
    (found / "direct_url.json").write_text(json.dumps(origin))
    monkeypatch.syspath_prepend(tmp_path)
    assert install.install_command("fetch") == f'pip install "lerobot_policy_agpd[fetch] @ {expected}"'
