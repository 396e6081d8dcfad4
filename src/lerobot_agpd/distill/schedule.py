"""When the two stages alternate."""

from __future__ import annotations

from lerobot_agpd.collect.config import CollectConfig


def due_round(updates: int, config: CollectConfig, total_steps: int | None) -> int | None:
    """Number of the collection round that is due after `updates` training steps, or None.

    Round 0 comes after the warm-up, then one every `collect.every` steps. None comes after the last training
    step, because no student would learn from it.
    """
    if not config.enabled or updates == total_steps or updates < config.warmup:
        return None
    number, remainder = divmod(updates - config.warmup, config.every)
    if remainder or (config.rounds is not None and number >= config.rounds):
        return None
    return number
