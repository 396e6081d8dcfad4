import pytest
import torch
from hypothesis import given, settings, strategies as st
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
from lerobot.lerobot_types import TransitionKey
from lerobot.processor import NormalizerProcessorStep

from lerobot_agpd.policies.agpd.configuration_agpd import AGPDConfig
from lerobot_agpd.replay.normalization import Normalizer, floor_statistics, matching_normalizer

KEY = "observation.environment_state"


def config(mode="MEAN_STD") -> AGPDConfig:
    return AGPDConfig(
        device="cpu",
        input_features={KEY: PolicyFeature(FeatureType.ENV, (2,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
        normalization_mapping={kind: NormalizationMode(mode) for kind in ("ENV", "ACTION")},
    )


def stats(mean, std, low, high):
    entry = {"mean": torch.tensor(mean), "std": torch.tensor(std)}
    entry |= {"min": torch.tensor(low), "max": torch.tensor(high)}
    return {key: dict(entry) for key in (KEY, "action")}


ONE = stats([1.0, -2.0], [2.0, 0.5], [0.0, -4.0], [4.0, 0.0])
OTHER = stats([1.1, -2.0], [2.0, 0.5], [0.0, -4.0], [4.4, 0.0])


@given(
    st.sampled_from(["MEAN_STD", "MIN_MAX", "IDENTITY"]),
    st.sampled_from([KEY, "action"]),
    st.lists(st.tuples(st.floats(-20, 20), st.floats(0.05, 20)), min_size=2, max_size=2),
    st.sampled_from([(2,), (3, 2), (3, 4, 2)]),
)
@settings(deadline=None)
def test_property_round_trip(mode, key, spreads, shape):
    center, width = (list(column) for column in zip(*spreads, strict=True))
    high = [c + w for c, w in spreads]
    normalizer = Normalizer(config(mode), stats(center, width, center, high))
    raw = torch.randn(shape) * 10
    back = normalizer.unnormalize(key, normalizer.normalize(key, raw))
    torch.testing.assert_close(back, raw, rtol=1e-4, atol=1e-3)


def test_by_hand():
    raw = torch.tensor([[3.0, -3.0]])
    assert Normalizer(config("MEAN_STD"), ONE).normalize(KEY, raw).tolist() == [[1.0, -2.0]]
    assert Normalizer(config("MIN_MAX"), ONE).normalize("action", raw).tolist() == [[0.5, -0.5]]
    assert Normalizer(config("MIN_MAX"), ONE).unnormalize("action", torch.tensor([[1.0, 0.0]])).tolist() == [
        [4.0, -2.0]
    ]


def test_normalize_is_what_lerobots_step_does():
    settings_ = config()
    features = {**settings_.input_features, **settings_.output_features}
    step = NormalizerProcessorStep(features=features, norm_map=settings_.normalization_mapping, stats=ONE)
    raw = {KEY: torch.randn(4, 2), "action": torch.randn(4, 2)}
    theirs = step({TransitionKey.OBSERVATION: {KEY: raw[KEY]}, TransitionKey.ACTION: raw["action"]})
    ours = Normalizer(settings_, ONE)
    assert torch.equal(ours.normalize(KEY, raw[KEY]), theirs[TransitionKey.OBSERVATION][KEY])
    assert torch.equal(ours.normalize("action", raw["action"]), theirs[TransitionKey.ACTION])


def test_floor_statistics_by_hand():
    original = stats([1.0, 2.0], [0.5, 0.0], [0.0, 2.0], [4.0, 2.002])
    floored = floor_statistics(original, floor=0.01)["action"]
    assert floored["std"].tolist() == pytest.approx([0.5, 0.01])
    assert floored["mean"].tolist() == [1.0, 2.0]
    assert floored["min"].tolist() == pytest.approx([0.0, 1.991])
    assert floored["max"].tolist() == pytest.approx([4.0, 2.011])
    assert original["action"]["std"].tolist() == [0.5, 0.0]  # a copy
    assert original["action"]["max"].tolist() == pytest.approx([4.0, 2.002])


def test_floor_statistics_leaves_entries_without_spread_alone():
    assert floor_statistics({"x": {"count": 3, "mean": [1.0]}}) == {"x": {"count": 3, "mean": [1.0]}}


@pytest.mark.parametrize("mode", ["MEAN_STD", "MIN_MAX"])
def test_rounding_errors_of_a_constant_feature_stay_small(mode):
    constant = stats([0.3, 1.0], [0.0, 1.0], [0.3, 0.0], [0.3, 2.0])
    raw = torch.tensor([[0.3 + 1e-6, 1.0]])
    assert Normalizer(config(mode), floor_statistics(constant)).normalize(KEY, raw).abs().max() < 0.01
    assert Normalizer(config(mode), constant).normalize(KEY, raw).abs().max() > 1


@pytest.mark.parametrize("right", [0, 1])
def test_matching_normalizer_picks_the_statistics_in_use(right):
    raw = {KEY: torch.randn(8, 2) * 3, "action": torch.randn(8, 2) * 3}
    loop = Normalizer(config(), (ONE, OTHER)[right])
    delivered = {key: loop.normalize(key, values) for key, values in raw.items()}
    found = matching_normalizer(config(), [("one", ONE), ("other", OTHER)], raw, delivered)
    for key, values in raw.items():
        assert torch.equal(found.normalize(key, values), delivered[key])


def test_first_of_equal_candidates_wins():
    raw = {KEY: torch.randn(8, 2), "action": torch.randn(8, 2)}
    almost = stats([1.0, -2.0], [2.0, 0.5 + 1e-7], [0.0, -4.0], [4.0, 0.0])
    delivered = {key: Normalizer(config(), ONE).normalize(key, values) for key, values in raw.items()}
    found = matching_normalizer(config(), [("almost", almost), ("one", ONE)], raw, delivered)
    assert found.stats["action"]["std"][1] == almost["action"]["std"][1]


def test_one_feature_that_does_not_match_is_enough_to_refuse():
    raw = {KEY: torch.randn(8, 2), "action": torch.randn(8, 2)}
    loop = Normalizer(config(), ONE)
    delivered = {key: loop.normalize(key, values) for key, values in raw.items()}
    delivered["action"] = delivered["action"] * 1.05 + 0.05
    with pytest.raises(ValueError, match="no known statistics.*'one'.*'other'"):
        matching_normalizer(config(), [("one", ONE), ("other", OTHER)], raw, delivered)


@pytest.mark.parametrize("key", [KEY, "action"])
def test_one_nan_matches_no_statistics(key):
    raw = {KEY: torch.randn(8, 2), "action": torch.randn(8, 2)}
    delivered = {name: Normalizer(config(), ONE).normalize(name, values) for name, values in raw.items()}
    delivered[key][3, 1] = float("nan")
    with pytest.raises(ValueError, match="no known statistics"):
        matching_normalizer(config(), [("one", ONE)], raw, delivered)
