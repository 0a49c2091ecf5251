# This source code is licensed under the MIT license found in the LICENSE file.
"""A policy of torchrl_koap behind LeRobot's interface."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NoReturn

import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDatasetMetadata
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_PREFIX, OBS_STATE
from torch import Tensor

from lerobot_policy_koap.configuration_koap import NO_TRAINING, KoapConfig
from torchrl_koap import Agent, Trained, load_policy
from torchrl_koap.files import some
from torchrl_koap.training.lerobot_folder import WEIGHTS, camera_features, number_features, write_lerobot_folder
from torchrl_koap.vision.observer import STATE


class KoapPolicy(PreTrainedPolicy):
    """Acts as a :class:`torchrl_koap.Agent` in a batch of LeRobot's environments, or on a robot.

    Args:
        config (KoapConfig): of the folder.
        trained (Trained): of :meth:`from_pretrained`.
        dataset_meta (LeRobotDatasetMetadata, optional): what LeRobot is about to record.
        **kwargs: not read.

    Raises:
        ValueError: without ``trained``, or if numbers or order of the columns differ.
    """

    config_class = KoapConfig
    name = "koap"

    def __init__(
        self,
        config: KoapConfig,
        trained: Trained | None = None,
        *,
        dataset_meta: LeRobotDatasetMetadata | None = None,
        **kwargs: Any,
    ):
        super().__init__(config)
        if trained is None:
            raise ValueError(f"there are no weights. {NO_TRAINING}")
        self.trained, self.policy = trained, load_policy(trained)
        self._numbers, self._cameras = number_features(trained), camera_features(trained)
        self._agent: Agent | None = None
        feature = (config.output_features or {}).get(ACTION)
        if feature is not None:
            _check_width(ACTION, feature.shape[-1], trained.task.action_names)
        if dataset_meta is not None:
            self._check_robot(dataset_meta)

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: str | Path,
        *,
        config: KoapConfig | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
        **kwargs: Any,
    ) -> KoapPolicy:
        """Loads a folder of ``koap export --format lerobot`` or :meth:`save_pretrained`; nothing is downloaded.

        Args:
            pretrained_name_or_path (str or Path): the folder.
            config (KoapConfig, optional): in place of the folder's.
            dataset_meta (LeRobotDatasetMetadata, optional): what LeRobot is about to record.
            **kwargs: not read.

        Raises:
            FileNotFoundError: if the folder has no weights.
            CheckpointError: if they are damaged or of another version.
            ValueError: if numbers or order of the columns differ.
        """
        file = Path(pretrained_name_or_path) / WEIGHTS
        if not file.is_file():
            raise FileNotFoundError(
                f"{file} is missing: `koap export RUN --format lerobot --out DIR` writes such a folder, and one of the"
                " Hub has to be downloaded first"
            )
        config = PreTrainedConfig.from_pretrained(file.parent) if config is None else config
        trained = Trained.load(file, plugins=config.plugins)
        return cls(config, trained, dataset_meta=dataset_meta).to(config.device).eval()

    def _save_pretrained(self, save_directory: Path) -> None:
        write_lerobot_folder(self.trained, save_directory)
        self.config._save_pretrained(save_directory)

    def reset(self) -> None:
        """Begins an episode in every environment; the start noise goes on in its streams."""
        if self._agent is None:
            self._agent = Agent(self.policy, seed=self.config.seed)
        self._agent.reset()

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """Returns the next action ``[n, act]`` in the robot's units.

        Args:
            batch (dict): the features: numbers ``[n, d]`` and frames ``[n, 3, H, W]`` in 0 to 1.
            **kwargs: not read.

        Raises:
            ValueError: if a feature is missing, of another width or not finite.
        """
        if self._agent is None:
            self.reset()
        return torch.as_tensor(self._agent.act(self._observed(batch)))

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Any], noise: Tensor | None = None, **kwargs: Any) -> Tensor:
        """Returns the actions until the next plan ``[n, steps, act]``, decided by this observation alone.

        Its frames are taken for the past ones too, and no step is looked at on the way: :meth:`select_action` does
        better.

        Args:
            batch (dict): as for :meth:`select_action`.
            noise (Tensor, optional): standard normal ``[n, *noise_shape]``. Default: random.
            **kwargs: not read.

        Raises:
            ValueError: as :meth:`select_action`.
        """
        given, policy = self._observed(batch), self.policy
        seen = given if isinstance(given, Tensor) else policy.observe(given)
        like = next(policy.parameters())
        history = policy.from_robot(seen).to(like).unsqueeze(-2).expand(-1, policy.history, -1)
        noise = torch.randn(*history.shape[:-2], *policy.noise_shape) if noise is None else noise
        return policy.to_robot(policy.decode_ahead(history, noise.to(like))[0])

    def forward(self, batch: dict[str, Any]) -> NoReturn:
        """Refuses to train.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(NO_TRAINING)

    def get_optim_params(self) -> NoReturn:
        """Refuses to train.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(NO_TRAINING)

    def _observed(self, batch: dict[str, Any]) -> Tensor | dict[str, Tensor]:
        """What an agent takes: a vector, or numbers and frames by camera."""
        wanted = [*self._numbers, *self._cameras.values()]
        missing = [feature for feature in wanted if feature not in batch]
        if missing:
            given = [name for name in batch if name.startswith(OBS_PREFIX)]
            raise ValueError(
                f"the observation has no {missing[0]}: the policy takes {', '.join(wanted)}, got"
                f" {', '.join(given) or 'none'}; see --env.obs_type and --rename_map"
            )
        for feature, columns in self._numbers.items():
            _check_width(feature, batch[feature].shape[-1], columns)
        seen = {feature: batch[feature].cpu() for feature in wanted}  # where frames are embedded; the agent moves them
        numbers = torch.cat([seen[feature] for feature in self._numbers], -1) if self._numbers else None
        if not self._cameras:
            return numbers
        frames = {
            camera: (seen[feature] * 255).round().to(torch.uint8).movedim(-3, -1)
            for camera, feature in self._cameras.items()
        }
        return frames if numbers is None else {STATE: numbers, **frames}

    def _check_robot(self, meta: LeRobotDatasetMetadata) -> None:
        """Compares width, order and rate of a robot's columns with those of the training."""
        own = {OBS_STATE: self._numbers.get(OBS_STATE, ()), ACTION: self.trained.task.action_names}
        for feature, columns in own.items():
            names = (meta.features.get(feature) or {}).get("names")
            if not columns or not isinstance(names, list):
                continue
            _check_width(feature, len(names), columns)
            if sorted(names) == sorted(columns) and tuple(names) != tuple(columns):
                raise ValueError(f"{feature} is {', '.join(names)}; the policy has another order: {', '.join(columns)}")
        self.policy.check_rate(meta.fps)


def _check_width(feature: str, width: int, columns: tuple[str, ...]) -> None:
    if width != len(columns):
        raise ValueError(f"{feature} has {width} columns, the policy has {len(columns)}: {some(columns)}")
