"""Every number that a run logs is on the page about metrics."""

import re
from pathlib import Path

from toy_run import ROUND_STEPS

PAGE = Path(__file__).parents[2] / "docs" / "metrics.md"


def test_every_logged_metric_is_explained(start) -> None:
    run = start().train(until=ROUND_STEPS[0] + 1)
    logged = {name for log in run.logs for name in log} - {"loss"}
    explained = {name for line in PAGE.read_text().splitlines() for name in re.findall(r"`(\w+)`", line)}
    assert logged - explained == set()
    assert {"strategy_success", "discriminator_loss", "grad_norm_student"} <= logged, "the run logs the usual"
