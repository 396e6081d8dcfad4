"""An imported recording of robosuite, played again in the environment type."""

import numpy as np
import pytest

pytest.importorskip("h5py")
pytest.importorskip("robosuite")
pytestmark = pytest.mark.slow

from robomimic_files import column, make_lift, record, run_import, write  # noqa: E402

from lerobot_agpd.envs.robomimic_hdf5 import RobomimicFile  # noqa: E402
from lerobot_agpd.envs.robomimic_recordings import RECORDINGS_PATH  # noqa: E402


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    """Two real demonstrations that lift the cube."""
    env = make_lift()
    played = [record(env, seed, n_steps) for seed, n_steps in enumerate((48, 47))]
    env.close()
    folder = tmp_path_factory.mktemp("robosuite")
    return run_import(write(folder / "low_dim_v15.hdf5", played), folder / "data")


def test_recorded_actions_replayed_reproduce_the_recording(imported):
    from lerobot_agpd.envs.robosuite_sim import RobosuiteEnv

    with RobomimicFile(imported.root / RECORDINGS_PATH) as file:
        actions, recorded_states = (file.read("demo_1", key) for key in ("actions", "states"))
        model_xml = file.model_xml("demo_1")
    env = RobosuiteEnv("lift")
    observation, _ = env.reset_to(recorded_states[0], model_xml)
    states, successes, observations = [], [], []
    for action in actions:
        states.append(env.get_state())
        observations.append(observation)
        observation, *_, info = env.step(action)
        successes.append(info["is_success"])
    env.close()
    np.testing.assert_allclose(states, recorded_states, atol=1e-3)
    positions = slice(1, 17)  # after the time: seven joints, two fingers, the cube's position and quaternion
    np.testing.assert_allclose(np.array(states)[:, positions], recorded_states[:, positions], atol=1e-4)
    assert successes == column(imported, "next.success", 1).ravel().tolist() and successes[-1]
    for raw, key in (
        ("agent_pos", "observation.state"),
        ("environment_state", "observation.environment_state"),
    ):
        shown = np.stack([seen[raw] for seen in observations])
        np.testing.assert_allclose(shown, column(imported, key, 1), atol=1e-4)
