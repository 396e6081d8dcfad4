"""The cards of a run: its checkpoints', its episodes', and what an upload would contain."""

import shutil

import pytest
from huggingface_hub import ModelCard
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.policies import pretrained

from lerobot_agpd.replay.export import merge


@pytest.fixture
def hub(monkeypatch, tmp_path):
    """A folder that gets what LeRobot uploads, in place of huggingface.co."""

    class Hub:
        url = "nowhere"

        def create_repo(self, repo_id, **options):
            self.repo_id, self.repo_url = repo_id, self
            return self

        def upload_folder(self, folder_path, **options):
            shutil.copytree(folder_path, tmp_path / "hub")
            return self

    monkeypatch.setattr(pretrained, "HfApi", Hub)
    monkeypatch.setattr(ModelCard, "validate", lambda self: None)  # asks huggingface.co
    return tmp_path / "hub"


def test_a_runs_cards(start, hub):
    run = start().train(until=4).save()
    agpd, policy = run.agpd, run.policy
    text = (run.checkpoint / "README.md").read_text()
    total = agpd.reports[0].total
    assert f"1: {total.generated} episodes generated, {total.kept} kept" in text
    assert agpd.config.teacher.path in text and "3 of 3 episodes" in text
    assert f"| 0 | 3 | {agpd.reports[0].strength:.3g} |" in text

    policy.config.repo_id = "me/student"
    config = TrainPipelineConfig(dataset=DatasetConfig(repo_id="local/small"), policy=policy.config)
    policy.push_model_to_hub(config, dataset_meta=run.dataset.meta)
    pushed = (hub / "README.md").read_text()
    assert "--policy.path=me/student" in pushed and "episodes generated" in pushed

    merged = merge(agpd.journal.root)
    card = (merged.root / "README.md").read_text()
    kept = sum(record.length for record in run.records(0) if record.kept)
    assert f"| 0 | {total.generated} | {total.successful} | {total.kept} | {kept} |" in card
    assert agpd.config.teacher.path in card and "agpd.strength" in card
