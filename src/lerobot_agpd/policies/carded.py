"""A model card with every checkpoint, and on the Hub."""

from abc import abstractmethod
from pathlib import Path
from typing import Any

from huggingface_hub import ModelCard
from lerobot.configs import PreTrainedConfig

from lerobot_agpd.cards.model_card import CARD, ModelFacts, model_card
from lerobot_agpd.files import write_text
from lerobot_agpd.weights import is_main_process


class CardedPolicy:
    """Mixin: a policy that writes its model card beside its weights, before LeRobot's policy in the bases."""

    @property
    def _own_config(self) -> PreTrainedConfig:
        return self.config  # type: ignore[attr-defined]  # of the policy that it is mixed into

    @abstractmethod
    def model_facts(self) -> ModelFacts | None:
        """What the card says; None for a policy that was loaded and not trained since."""

    def generate_model_card(self, *args: Any, **kwargs: Any) -> ModelCard:
        """The card that `push_model_to_hub` uploads; LeRobot's own knows no plugin."""
        facts = self.model_facts()
        if facts is None:
            return super().generate_model_card(*args, **kwargs)  # type: ignore[misc]
        card = model_card(self._own_config, facts)
        card.validate()  # by the Hub
        return card

    def _save_pretrained(self, save_directory: Path, **kwargs: Any) -> None:
        super()._save_pretrained(save_directory, **kwargs)  # type: ignore[misc]
        facts = self.model_facts()
        if facts is not None and is_main_process():
            write_text(Path(save_directory) / CARD, str(model_card(self._own_config, facts)))
