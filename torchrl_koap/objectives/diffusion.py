# This source code is licensed under the MIT license found in the LICENSE file.
"""Denoising losses: what trains the planner on states, and the Diffusion Policy on labelled actions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_koap import keys
from torchrl_koap.modules.diffusion.planner import StatePlanner
from torchrl_koap.modules.diffusion.policy import DiffusionPolicy
from torchrl_koap.objectives.base import read_entry, read_mask
from torchrl_koap.objectives.denoising import DenoisingLoss


class PlannerLoss(DenoisingLoss):
    r"""Mean squared error of the denoiser at random noise levels.

    With the normalised future ``x_0``, noise ``eps ~ N(0, I)`` and a random time ``t`` per plan::

        L = mean | denoiser(signal(t) x_0 + noise(t) eps, t, condition) - target |^2

    where the schedule's prediction type says whether the target is the clean plan or the noise.

    Args:
        planner (StatePlanner): planner to train, its normalisers already fitted.

    Keyword Args:
        create_target_params (bool): keep an averaged copy of the weights in ``target_planner_params``, to be moved by
            :class:`torchrl.objectives.SoftUpdate` and used for planning. Defaults to True.
        reduction (str): ``"mean"`` | ``"sum"`` | ``"none"`` over the elements ``[*B, H, d]``. Defaults to ``"mean"``.

    Raises:
        KeyError: if an entry is missing.
        ValueError: if an entry has another shape than the planner needs, or ``reduction`` is unknown.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_koap.modules import StatePlanner, TemporalUnet
        >>> from torchrl_koap.objectives import PlannerLoss
        >>> planner = StatePlanner(TemporalUnet(2, 4), state_dim=2)
        >>> loss = PlannerLoss(planner)
        >>> average = SoftUpdate(loss, eps=0.99)
        >>> loss(TensorDict({"state": torch.randn(8, 16, 2)}, [8]))["loss_planner"].backward()
        >>> average.step()
        >>> with loss.target_planner_params.to_module(planner):
        ...     plan = planner(TensorDict({"history": torch.randn(3, 2, 2)}, [3]))["plan"]
    """

    @dataclass
    class _AcceptedKeys:
        """Entries of the input; the last two are read if they are there.

        Attributes:
            state (NestedKey): windows ``[*B, history + horizon, d]``. Defaults to ``"state"``.
            noise (NestedKey): noise ``[*B, horizon, d]`` instead of random. Defaults to ``"planner_noise"``.
            time (NestedKey): time ``[*B]`` in training steps instead of random. Defaults to ``"planner_time"``.
        """

        state: NestedKey = keys.STATE
        noise: NestedKey = "planner_noise"
        time: NestedKey = "planner_time"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    name = "planner"
    out_keys = ["loss_planner"]

    planner: StatePlanner
    planner_params: TensorDictParams
    target_planner_params: TensorDictParams

    def __init__(self, planner: StatePlanner, **options: Any):
        super().__init__(planner, **options)

    def _entries(self) -> list[NestedKey]:
        return [self.tensor_keys.state]

    def read(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor | None]:
        """Histories and recorded futures, of which all steps count (:meth:`DenoisingLoss.read`)."""
        history, plan = self.planner.split_window(read_entry(tensordict, self.tensor_keys.state))
        return history, plan, None

    def encode(self, history: Tensor, sequence: Tensor, counts: Tensor | None) -> Tensor:
        """The normalised plans.

        Args:
            history (Tensor): raw histories ``[*B, h, d]``.
            sequence (Tensor): raw plans ``[*B, H, d]``.
            counts (Tensor, optional): None: all steps count.

        Returns:
            Tensor: ``[*B, H, d]``.
        """
        return self.planner.encode_plan(history, sequence)


class DiffusionPolicyLoss(DenoisingLoss):
    r"""Mean squared error of the denoiser of actions at random noise levels, on labelled steps.

    With the normalised actions ``a`` of frames ``history - 1 .. T - 2`` of a window, noise ``eps ~ N(0, I)`` and a
    random time ``t`` per window::

        L = mean over labelled steps | denoiser(signal(t) a + noise(t) eps, t, condition) - target |^2

    where the schedule's prediction type says whether the target is the clean actions or the noise.

    A step counts if it has a label and neither its frame nor the next one is padded. The denoiser sees steps that do
    not count as the middle of the range of actions, noise added; what was stored there (NaN) reaches neither value
    nor gradient. A batch without labels gives exactly 0. Labels are what this method lives on: draw windows with
    ``labelled_share=1`` (:class:`~torchrl_koap.data.WindowSampler`).

    Args:
        policy (DiffusionPolicy): policy to train, its normalisers already fitted.

    Keyword Args:
        create_target_params (bool): keep an averaged copy of the weights in ``target_policy_params``, to be moved by
            :class:`torchrl.objectives.SoftUpdate` and used for control. Defaults to True.
        reduction (str): ``"mean"`` | ``"sum"`` | ``"none"`` over the elements ``[*B, H, act]`` that count (``"none"``:
            0 where they do not). Defaults to ``"mean"``.

    Raises:
        KeyError: if an entry is missing.
        ValueError: if an entry has another shape than the policy needs, or ``reduction`` is unknown.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_koap.modules import DiffusionPolicy, TemporalUnet
        >>> from torchrl_koap.objectives import DiffusionPolicyLoss
        >>> policy = DiffusionPolicy(TemporalUnet(3, 4), state_dim=2, action_dim=3)
        >>> loss = DiffusionPolicyLoss(policy)
        >>> average = SoftUpdate(loss, eps=0.99)
        >>> batch = TensorDict({"state": torch.randn(8, 16, 2), "action": torch.randn(8, 16, 3),
        ...                     "has_action": torch.ones(8, 16, 1, dtype=torch.bool)}, [8])
        >>> loss(batch)["loss_policy"].backward()
        >>> average.step()
        >>> with loss.target_policy_params.to_module(policy):
        ...     actions = policy.sample(torch.randn(3, 2, 2))
    """

    @dataclass
    class _AcceptedKeys:
        """Entries of the input; the last three are read if they are there.

        Attributes:
            state (NestedKey): windows of raw states ``[*B, history + horizon, d]``. Defaults to ``"state"``.
            action (NestedKey): raw actions ``[*B, history + horizon, act]``, NaN where unlabelled. Defaults to
                ``"action"``.
            has_action (NestedKey): labelled frames, bool ``[*B, history + horizon, 1]``. Defaults to ``"has_action"``.
            padded (NestedKey): frames that repeat an edge of the trajectory, bool ``[*B, history + horizon]``. Defaults
                to ``"padded"``.
            noise (NestedKey): noise ``[*B, horizon, act]`` instead of random. Defaults to ``"policy_noise"``.
            time (NestedKey): time ``[*B]`` in training steps instead of random. Defaults to ``"policy_time"``.

        The two masks may have a trailing 1 or not.
        """

        state: NestedKey = keys.STATE
        action: NestedKey = keys.ACTION
        has_action: NestedKey = keys.HAS_ACTION
        padded: NestedKey = "padded"
        noise: NestedKey = "policy_noise"
        time: NestedKey = "policy_time"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    name = "policy"
    out_keys = ["loss_policy"]

    policy: DiffusionPolicy
    policy_params: TensorDictParams
    target_policy_params: TensorDictParams

    def __init__(self, policy: DiffusionPolicy, **options):
        super().__init__(policy, **options)

    def _entries(self) -> list[NestedKey]:
        return [self.tensor_keys.state, self.tensor_keys.action, self.tensor_keys.has_action]

    def read(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor | None]:
        """Histories, actions from now on and which of them are labelled (:meth:`DenoisingLoss.read`)."""
        state = read_entry(tensordict, self.tensor_keys.state)
        history, _ = self.policy.split_window(state)
        return history, *self._actions(tensordict, state)

    def encode(self, history: Tensor, sequence: Tensor, counts: Tensor | None) -> Tensor:
        """The normalised actions, 0 where they do not count.

        Args:
            history (Tensor): raw histories ``[*B, h, d]``.
            sequence (Tensor): raw actions ``[*B, H, act]``.
            counts (Tensor): steps that count, bool ``[*B, H, 1]``.

        Returns:
            Tensor: ``[*B, H, act]``.
        """
        # before the network and the residual: masking afterwards would leave NaN in the gradient
        return torch.where(counts, self.policy.encode_actions(torch.where(counts, sequence, 0.0)), 0.0)

    def _actions(self, tensordict: TensorDictBase, state: Tensor) -> tuple[Tensor, Tensor]:
        """Actions of the current and later steps ``[*B, H, act]``, and which of them count ``[*B, H, 1]``."""
        names, now = self.tensor_keys, self.policy.history - 1
        action = read_entry(tensordict, names.action)
        wanted = (*state.shape[:-1], self.policy.action_dim)
        if action.shape != wanted:
            raise ValueError(f"{names.action!r} must be {list(wanted)} ([*B, T, act]), got {list(action.shape)}")
        counts = read_mask(tensordict, names.has_action, state)[..., now:-1]
        if tensordict.get(names.padded, None) is not None:
            padded = read_mask(tensordict, names.padded, state)[..., now:]
            counts = counts & ~(padded[..., 1:] | padded[..., :-1])
        return action[..., now:-1, :], counts.unsqueeze(-1)
