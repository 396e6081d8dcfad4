"""Adapters: how each family of LeRobot policies is sampled, and which adapter belongs to which policy.

An adapter is imported with the first policy that needs it, so that pi0 or smolvla cost nothing unless they teach.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable
from typing import Any

from lerobot.policies import PreTrainedPolicy
from lerobot.processor import PolicyAction, PolicyProcessorPipeline

from lerobot_agpd.guidance.teacher import Teacher

_ADAPTERS: dict[str, str | type[Teacher]] = {
    "diffusion": "lerobot_agpd.guidance.adapters.diffusion:DiffusionTeacher",
    "multi_task_dit": "lerobot_agpd.guidance.adapters.flow:MultiTaskDiTTeacher",
    "pi0": "lerobot_agpd.guidance.adapters.rtc:RTCTeacher",
    "pi05": "lerobot_agpd.guidance.adapters.rtc:RTCTeacher",
    "smolvla": "lerobot_agpd.guidance.adapters.rtc:RTCTeacher",
}
_ANY_OTHER = "lerobot_agpd.guidance.adapters.chunk:ChunkTeacher"


def register_teacher(policy_type: str) -> Callable[[type[Teacher]], type[Teacher]]:
    """Register the decorated adapter for teachers of a policy type and of the types derived from it.

    Args:
        policy_type: the `name` of a LeRobot policy class, which is also its `--policy.type`.
    """

    def register(adapter: type[Teacher]) -> type[Teacher]:
        _ADAPTERS[policy_type] = adapter
        return adapter

    return register


def adapter_of(policy_class: type[PreTrainedPolicy]) -> type[Teacher]:
    """Import and return the adapter of a policy class: that of the nearest base class which has one."""
    names = [vars(base).get("name") for base in policy_class.__mro__]
    adapter = next((_ADAPTERS[name] for name in names if name in _ADAPTERS), _ANY_OTHER)
    return pkgutil.resolve_name(adapter) if isinstance(adapter, str) else adapter


def as_teacher(
    policy: PreTrainedPolicy,
    preprocessor: PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    postprocessor: PolicyProcessorPipeline[PolicyAction, PolicyAction],
) -> Teacher:
    """Wrap a policy and its processors as a teacher; they are neither copied nor changed."""
    return adapter_of(type(policy))(policy, preprocessor, postprocessor)
