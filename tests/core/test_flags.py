import json
from dataclasses import dataclass, field

import draccus
import pytest
from hypothesis import given, strategies as st

from lerobot_agpd.collect.config import (
    CollectConfig,
    DiagnosticsConfig,
    MixingConfig,
    RollinConfig,
    VariationConfig,
)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"schedule": "constant"}, [0.6, 0.6, 0.6, 0.6]),
        ({"schedule": "linear", "rounds": 2}, [0.0, 0.3, 0.6, 0.6]),
        ({"schedule": "exponential", "decay": 0.5}, [0.0, 0.3, 0.45, 0.525]),
        ({"schedule": "exponential", "decay": 0.0}, [0.0, 0.6, 0.6, 0.6]),  # beta = indicator of round 0
    ],
)
def test_schedules_by_hand(options, expected):
    config = MixingConfig(weight=0.6, **options)
    assert [config.weight_at(number) for number in range(4)] == pytest.approx(expected)


@given(st.floats(0, 1), st.sampled_from(["constant", "linear", "exponential"]), st.floats(0, 0.99))
def test_property_weights_rise_to_the_limit(weight, schedule, decay):
    config = MixingConfig(weight=weight, schedule=schedule, decay=decay)
    weights = [config.weight_at(number) for number in range(30)]
    assert weights == sorted(weights) and weights[0] >= 0 and weights[-1] <= weight


@pytest.mark.parametrize(
    ("group", "kind", "options"),
    [
        ("mixing", MixingConfig, {"form": "add"}),
        ("mixing", MixingConfig, {"weight": 1.1}),
        ("mixing", MixingConfig, {"schedule": "cosine"}),
        ("mixing", MixingConfig, {"rounds": 0}),
        ("mixing", MixingConfig, {"decay": 1.0}),
        ("rollin", RollinConfig, {"max_fraction": 0.0}),
        ("rollin", RollinConfig, {"episode_steps": 0}),
        ("variation", VariationConfig, {"quantile": 1.0}),
        ("variation", VariationConfig, {"scale_spread": 0.5}),
        ("diagnostics", DiagnosticsConfig, {"observations": -1}),
        ("diagnostics", DiagnosticsConfig, {"samples": 1}),
        ("diagnostics", DiagnosticsConfig, {"neighbours": 0}),
        ("diagnostics", DiagnosticsConfig, {"states": 3}),
        ("diagnostics", DiagnosticsConfig, {"epsilon": 0.0}),
    ],
)
def test_wrong_flags_are_named(group, kind, options):
    with pytest.raises(ValueError, match=f"--policy.collect.{group}.{next(iter(options))}"):
        kind(**options)


@pytest.mark.parametrize("strategy", ["replay", "mixing"])
@pytest.mark.parametrize("options", [{"quantile": 0.5}, {"scale_spread": 2.0}])
def test_variation_of_guidance_needs_guidance(strategy, options):
    with pytest.raises(ValueError, match=f"strategy={strategy}.*strategy=guided or rollin"):
        CollectConfig(strategy=strategy, variation=VariationConfig(**options))
    assert CollectConfig(strategy="rollin", variation=VariationConfig(**options)).guides


@dataclass
class Command:
    collect: CollectConfig = field(default_factory=CollectConfig)


def test_flags_parse_and_round_trip():
    flags = ["--collect.strategy=mixing", "--collect.mixing.form=switch", "--collect.mixing.relabel=true"]
    config = draccus.parse(Command, args=[*flags, "--collect.diagnostics.observations=0"])
    expected = CollectConfig(
        strategy="mixing",
        mixing=MixingConfig(form="switch", relabel=True),
        diagnostics=DiagnosticsConfig(observations=0),
    )
    assert config.collect == expected
    encoded = json.loads(json.dumps(draccus.encode(config)))
    assert draccus.decode(Command, encoded) == config


def test_flags_of_older_checkpoints_still_load():
    encoded = draccus.encode(Command())
    for name in ("mixing", "rollin", "variation", "diagnostics"):
        del encoded["collect"][name]
    assert draccus.decode(Command, encoded) == Command()
