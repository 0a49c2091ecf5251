# This source code is licensed under the MIT license found in the LICENSE file.
"""Diffusion Policy: a generative model of the next actions given the last observed states, without a plan between."""

from __future__ import annotations

from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_koap import keys
from torchrl_koap.modules.diffusion.base import ConditionedDiffusion, identity_normalizer
from torchrl_koap.modules.diffusion.noise_schedule import NoiseSchedule
from torchrl_koap.modules.normalizer import Normalizer

ACTION_CHUNK = "action_chunk"


class DiffusionPolicy(ConditionedDiffusion):
    """Samples the next ``horizon`` actions given the last ``history`` states (Chi et al. 2023).

    What the planner is for states, this is for actions: same denoiser, noise, solvers and condition. It learns from
    labelled steps alone. The first action of a chunk is the one to take *now*, in the last frame of the history::

        frame        0      1      2      3      ...  14          (history = 2, horizon = 14)
                     x_0    x_1
        chunk               a_1    a_2    a_3    ...  a_14        a_t moves x_t to x_{t+1}
        entry               0      1      2      ...  13

    KOAP's first public code diffuses ``a_2, a_3, ...`` here and begins to execute them in frame 1, one step too early.

    The condition is the planner's: states as they are, or with ``relative=True`` older frames as displacements from
    the current one. Sampling starts from random noise, also under ``ExplorationType.DETERMINISTIC``
    (:class:`~torchrl_koap.modules.diffusion.planner.StatePlanner`).

    Args:
        denoiser (nn.Module): ``denoiser(sequence [*B, H, act], time [*B], condition [*B, h * d + f]) -> [*B, H, act]``.
        schedule (NoiseSchedule, optional): noise schedule and prediction type. Defaults to ``NoiseSchedule()``.

    Keyword Args:
        state_dim (int): number ``d`` of state columns.
        action_dim (int): number ``act`` of action entries.
        history (int): number ``h`` of observed frames, the current one included. Defaults to 2.
        horizon (int): number ``H`` of actions in a chunk. Defaults to 14.
        relative (bool): the condition holds displacements from the current state. Defaults to False.
        features (nn.Module, optional): ``features(history [*B, h, d]) -> [*B, f]`` with the attribute ``num_features``:
            further numbers that the condition holds.
        solver (str): a name in ``SOLVERS``. Defaults to ``"dpm++2m"``.
        num_steps (int): solver steps. Defaults to 10.
        clip (float, optional): bound of the normalised actions at every solver step. Defaults to no bound; ``1.0``
            suits ``"minmax"`` statistics.
        in_keys (list of NestedKey): the entry of the history ``[*B, h, d]`` in raw units. Defaults to ``["history"]``.
        out_keys (list of NestedKey): the entry of the actions ``[*B, H, act]`` in raw units. Defaults to
            ``["action_chunk"]``.
        noise_key (NestedKey, optional): entry of start noise ``[*B, H, act]``, read if present. Defaults to
            ``"noise"``.

    Raises:
        ValueError: for a history of another length or width, noise of another shape, an unknown solver.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import DiffusionPolicy, NoiseSchedule, TemporalUnet
        >>> policy = DiffusionPolicy(TemporalUnet(3, 4), NoiseSchedule(), state_dim=2, action_dim=3, num_steps=4)
        >>> policy.fit_normalizers(torch.randn(100, 16, 2), torch.randn(500, 3))
        >>> policy(TensorDict({"history": torch.randn(5, 2, 2)}, [5]))["action_chunk"].shape
        torch.Size([5, 14, 3])
    """

    width_name = "action_dim"

    def __init__(
        self,
        denoiser: nn.Module,
        schedule: NoiseSchedule | None = None,
        *,
        state_dim: int,
        action_dim: int,
        relative: bool = False,
        **options,
    ):
        super().__init__(
            denoiser,
            schedule,
            state_dim=state_dim,
            width=action_dim,
            relative=relative,
            in_key=keys.HISTORY,
            out_key=ACTION_CHUNK,
            **options,
        )
        self.action_dim = action_dim
        self.action_normalizer = identity_normalizer(action_dim)

    def set_keys(self, *, history: NestedKey | None = None, action_chunk: NestedKey | None = None) -> None:
        """Renames the entries read and written.

        Keyword Args:
            history (NestedKey, optional): entry of the history.
            action_chunk (NestedKey, optional): entry of the actions.
        """
        self._rename(history, action_chunk)

    def fit_normalizers(self, windows: Tensor, actions: Tensor, *, mode: str = "minmax") -> None:
        """Takes the statistics of condition and actions from data; call it before a loss is built on the policy.

        Args:
            windows (Tensor): states in raw units, ``[*N, history + horizon, d]``; no label is needed for them.
            actions (Tensor): labelled actions in raw units, ``[*M, act]``. All steps of a chunk share their statistics.

        Keyword Args:
            mode (str): ``"minmax"``, ``"standard"``, ``"rms"`` or ``"identity"`` (see
                :class:`~torchrl_koap.modules.normalizer.Normalizer`).

        Raises:
            ValueError: for windows or actions of another shape, no actions, or actions that are not finite: they
                must be those of the label budget.
        """
        if actions.ndim < 2 or actions.shape[-1] != self.action_dim:
            raise ValueError(f"actions must be [*M, {self.action_dim}] (action_dim), got {list(actions.shape)}")
        history, _ = self.split_window(windows.reshape(-1, *windows.shape[-2:]))
        example = self.action_normalizer.scale
        condition = Normalizer.fit(self.condition(history), mode=mode)
        self.action_normalizer = Normalizer.fit(actions, mode=mode).to(example)
        self.condition_normalizer = condition.to(example)

    def encode_actions(self, actions: Tensor) -> Tensor:
        """Raw actions ``[*B, H, act]`` to the normalised sequence that noise is added to."""
        self._check_sequence(actions)
        return self.action_normalizer(actions)

    def decode_actions(self, sequence: Tensor) -> Tensor:
        """Inverse of :meth:`encode_actions`: sequences ``[*B, H, act]`` in raw units."""
        return self.action_normalizer.inverse(sequence)

    def decode(self, history: Tensor, sequence: Tensor) -> Tensor:
        """Raw actions of normalised sequences: :meth:`decode_actions`, which do not depend on where the state is.

        Args:
            history (Tensor): raw histories ``[*B, h, d]``; not looked at.
            sequence (Tensor): normalised sequences ``[*B, H, act]``.

        Returns:
            Tensor: raw actions ``[*B, H, act]``.
        """
        return self.decode_actions(sequence)
