# This source code is licensed under the MIT license found in the LICENSE file.
"""What LeRobot asks about a policy before it is loaded."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NoReturn

from lerobot.configs.policies import PreTrainedConfig

NO_TRAINING = (
    "LeRobot does not train koap policies: train with `koap train`, write the folder with"
    " `koap export RUN --format lerobot --out DIR`, run it with --policy.path=DIR"
)


@PreTrainedConfig.register_subclass("koap")
@dataclass
class KoapConfig(PreTrainedConfig):
    """Describes a policy that ``koap export RUN --format lerobot`` wrote; the weights' file holds all else.

    Args:
        seed (int): seed of the plans' start noise; robot ``i`` of a batch draws with ``seed + i``.
        plugins (list of str): modules that register the task or method, or hold the network that embeds frames. They
            are imported, so a folder never names them itself.
    """

    seed: int = 0
    plugins: list[str] = field(default_factory=list)

    @property
    def observation_delta_indices(self) -> None:
        """None: an agent keeps the last observations itself."""
        return None

    @property
    def action_delta_indices(self) -> None:
        """None: there is no training."""
        return None

    @property
    def reward_delta_indices(self) -> None:
        """None: there is no training."""
        return None

    def get_optimizer_preset(self) -> NoReturn:
        """Refuses ``lerobot-train``.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(NO_TRAINING)

    def get_scheduler_preset(self) -> None:
        """Returns None: there is no training."""
        return None

    def validate_features(self) -> None:
        """Checks nothing: :class:`KoapPolicy` knows its columns."""
