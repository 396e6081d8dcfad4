"""Episodes with numbers that are not finite: dropped and counted, and a round of them stops the run."""

import numpy as np
import pytest
import torch
from point_environment import Point
from toy_run import EPISODES


@pytest.fixture
def break_environment(monkeypatch):
    """Makes the environment deliver NaN in some of its episodes, counted from 0, from the second step on."""

    def break_it(what, episodes):
        counter, reset, step = iter(range(10**6)), Point.reset, Point.step

        def counted_reset(self, **options):
            self.broken = next(counter) in episodes
            self.n_steps = 0
            return reset(self, **options)

        def broken_step(self, action):
            observation, reward, *rest = step(self, action)
            self.n_steps += 1
            if self.broken and self.n_steps == 2:
                if what == "reward":
                    reward = float("nan")
                else:
                    observation[what] = np.full_like(observation[what], np.nan)
            return observation, reward, *rest

        monkeypatch.setattr(Point, "reset", counted_reset)
        monkeypatch.setattr(Point, "step", broken_step)

    return break_it


BROKEN = {
    "agent_pos": "'observation.state' at step 2",
    "environment_state": "'observation.environment_state' at step 2",
    "reward": "'next.reward' at step 1",
}


@pytest.mark.parametrize("what", BROKEN)
def test_one_nan_from_the_environment_costs_its_episode_and_no_more(start, break_environment, caplog, what):
    """It is not kept although it succeeds, is counted, and the run goes on, also when resumed."""
    break_environment(what, episodes={1})
    run = start().train(until=4).save()
    (report,) = run.agpd.reports
    (record,) = [record for record in run.records(0) if record.invalid]
    assert record.invalid == f"{BROKEN[what]} is not finite" and not record.kept and not record.success
    assert report.total.invalid == 1 and report.total.generated == EPISODES and report.total.kept > 0
    (warning,) = [r.getMessage() for r in caplog.records if "not finite" in r.getMessage()]
    assert BROKEN[what] in warning and "1 of 6" in warning
    assert all(np.isfinite(columns).all() for columns in run.agpd.replay.table.columns.values())
    assert np.isfinite(run.logs[-1]["loss"])
    assert all(torch.isfinite(value).all() for value in run.policy.state_dict().values())
    resumed = start(run.checkpoint)
    assert resumed.agpd.reports == run.agpd.reports
    assert resumed.train(until=7).agpd.reports[1].total.invalid == 0


@pytest.mark.parametrize("what", BROKEN)
def test_a_round_of_mostly_invalid_episodes_stops_the_run(start, break_environment, what):
    break_environment(what, episodes=set(range(100)) - {1})
    run = start().train(until=2).save()
    with pytest.raises(RuntimeError, match=rf"of 6 episodes.*{BROKEN[what]}.*--env.*round-00000.*--resume"):
        run.train(until=3)
    assert run.agpd.journal.reports() == []
