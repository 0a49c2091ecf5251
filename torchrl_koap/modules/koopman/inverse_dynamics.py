# This source code is licensed under the MIT license found in the LICENSE file.
"""The Koopman inverse dynamics model: state windows in, latent actions and robot actions out."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn

from torchrl_koap.keys import ACTION, STATE
from torchrl_koap.modules.inverse_dynamics import InverseDynamics
from torchrl_koap.modules.koopman.action_decoder import LinearActionDecoder, RidgeFit
from torchrl_koap.modules.koopman.latent_action import LatentActionModule
from torchrl_koap.modules.koopman.lifting import KoopmanLifting, KoopmanOperator

NORMALIZED_STATE = "normalized_state"
NORMALIZED_ACTION = "normalized_action"


class KoopmanInverseDynamics(InverseDynamics, TensorDictSequential):
    r"""Infers latent actions from a window of states and decodes them linearly to robot actions.

    The *sequence* is the inference path: normalise, :math:`u_t = f_\theta(\cdot)`, :math:`a_t = D u_t + b`,
    de-normalise. Lifting and operator take no part in it; they are attributes that shape the latent actions in
    training through :math:`z_{t+1} = K z_t + u_t`.

    Args:
        latent_action (LatentActionModule): the network ``f``.
        action_decoder (LinearActionDecoder): the decoder ``d``.

    Keyword Args:
        lifting (KoopmanLifting): the networks ``g``.
        operator (KoopmanOperator): the matrix ``K``.
        state_normalizer (nn.Module, optional): maps raw states to the networks' units, which are written under
            ``"normalized_state"``.
        action_normalizer (nn.Module, optional): its ``inverse`` maps decoded actions, under ``"normalized_action"``, to
            raw units.
        in_key (NestedKey): window of raw states ``[*B, T, d]``. Defaults to ``"state"``.
        out_key (NestedKey): raw actions ``[*B, T, act]``; frame ``t`` holds the action from ``x_t`` to
            ``x_{t+1}``. Defaults to ``"action"``.

    The in-key of the network and the out-key of the decoder are set to fit.

    Raises:
        ValueError: if the sizes of the parts do not fit together, or the decoder does not read what the network writes.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import make_koopman_inverse_dynamics
        >>> model = make_koopman_inverse_dynamics(2, 2, preset="paper", latent_dim=16, hidden_dim=32)
        >>> td = model(TensorDict({"state": torch.randn(3, 16, 2)}, [3]))
        >>> td["action"].shape, td["latent_action"].shape
        (torch.Size([3, 16, 2]), torch.Size([3, 16, 16]))
    """

    def __init__(
        self,
        latent_action: LatentActionModule,
        action_decoder: LinearActionDecoder,
        *,
        lifting: KoopmanLifting,
        operator: KoopmanOperator,
        state_normalizer: nn.Module | None = None,
        action_normalizer: nn.Module | None = None,
        in_key: NestedKey = STATE,
        out_key: NestedKey = ACTION,
    ):
        sizes = {
            "latent_action": latent_action.latent_dim,
            "action_decoder": action_decoder.linear.in_features,
            "operator input": operator.input_dim,
        }
        if len(set(sizes.values())) > 1:
            raise ValueError(f"the sizes of a latent action differ: {sizes}")
        if lifting.latent_dim != operator.latent_dim:
            raise ValueError(f"latent_dim differs: lifting {lifting.latent_dim}, operator {operator.latent_dim}")
        if latent_action.state_dim != lifting.state_dim:
            raise ValueError(f"state_dim differs: latent_action {latent_action.state_dim}, lifting {lifting.state_dim}")

        if latent_action.out_keys != action_decoder.in_keys:
            written, read = latent_action.out_keys[0], action_decoder.in_keys[0]
            raise ValueError(f"latent_action writes {written!r}, but action_decoder reads {read!r}")

        # normalised values get entries of their own: written over raw ones they would be normalised twice
        latent_action.in_keys = [in_key] if state_normalizer is None else [NORMALIZED_STATE]
        action_decoder.out_keys = [out_key] if action_normalizer is None else [NORMALIZED_ACTION]
        steps = [latent_action, action_decoder]
        if state_normalizer is not None:
            steps.insert(0, TensorDictModule(state_normalizer, [in_key], [NORMALIZED_STATE]))
        if action_normalizer is not None:
            steps.append(TensorDictModule(_Inverse(action_normalizer), [NORMALIZED_ACTION], [out_key]))
        TensorDictSequential.__init__(self, *steps)
        self.latent_action, self.action_decoder = latent_action, action_decoder
        self.lifting, self.operator = lifting, operator
        self.state_normalizer, self.action_normalizer = state_normalizer, action_normalizer

    def set_keys(self, *, state: NestedKey | None = None, action: NestedKey | None = None) -> None:
        """Renames the entries read and written.

        Keyword Args:
            state (NestedKey, optional): new entry of the window of raw states.
            action (NestedKey, optional): new entry of the raw actions.
        """
        if state is not None:
            self.module[0].in_keys = [state]
        if action is not None:
            self.module[-1].out_keys = [action]
        self.in_keys, self.out_keys = self._compute_in_and_out_keys(self.module)

    # a property: assigned like that of other controllers, the network would be saved under two names
    @property
    def reader(self) -> LatentActionModule:  # type: ignore[override]
        """The network ``f``, which gathers what it reads."""
        return self.latent_action

    def lift(self, state: Tensor) -> Tensor:
        """Lifted states ``[*B, T, m]`` of raw states ``[*B, T, d]``."""
        return self.lifting.encode(self.normalize_state(state))

    def infer(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Latent actions of a window of raw states.

        Args:
            state (Tensor): window of raw states ``[*B, T, d]``.
            frames (range, optional): frames to infer for. Default: all ``T`` of the window.

        Returns:
            Tensor: ``[*B, len(frames), m]``.
        """
        return self.latent_action.infer(self.latent_action.gather(self.normalize_state(state), frames))

    def decode(self, latent_action: Tensor) -> Tensor:
        """Raw actions ``[*B, T, act]`` of latent actions."""
        return self.raw_action(self.action_decoder.linear(latent_action))

    def predict_next(self, lifted: Tensor, latent_action: Tensor) -> Tensor:
        """``K z_t + u_t``, the prediction of ``z_{t+1}``.

        Args:
            lifted (Tensor): lifted states ``z_t``, ``[*B, T, m]``.
            latent_action (Tensor): latent actions ``u_t``, ``[*B, T, input_dim]`` of the operator.

        Returns:
            Tensor: ``[*B, T, m]``.
        """
        return self.operator.step(lifted, latent_action)

    def rollout_latent(self, lifted: Tensor, latent_action: Tensor) -> Tensor:
        """Rolls the linear dynamics out from one lifted state.

        Args:
            lifted (Tensor): first lifted state ``[*B, m]``.
            latent_action (Tensor): latent actions ``[*B, T, m]`` of the following steps.

        Returns:
            Tensor: lifted states ``[*B, T, m]`` after each of the steps.
        """
        states = []
        for step in latent_action.unbind(-2):
            lifted = self.predict_next(lifted, step)
            states.append(lifted)
        return torch.stack(states, -2)

    @torch.no_grad()
    def fit_scales(self, windows: Tensor) -> None:
        """Sets what is known of the inputs before training: spreads, and the linear part of a lifting that has one.

        Args:
            windows (Tensor): raw states ``[*B, T, d]``; no label is read.
        """
        self.lifting.fit_unlabelled(self.normalize_state(windows))
        super().fit_scales(windows)

    @property
    def unfolds(self) -> bool:
        """Whether there is anything for :meth:`unfold` to train."""
        return self.lifting.unfolds

    def unfold(self, windows: Tensor, updates: int, progress: Callable[[int, int], None] | None = None) -> None:
        """Trains a compact lifting to coordinates along the surface that states lie on, before its losses do.

        Args:
            windows (Tensor): raw states ``[*B, T, d]``; no label is read.
            updates (int): see :meth:`~torchrl_koap.modules.koopman.compact_lifting.CompactLifting.unfold`.
            progress (callable, optional): likewise.
        """
        self.lifting.unfold(self.normalize_state(windows), updates, progress)

    @torch.no_grad()
    def fit_unlabelled(self, windows: Tensor) -> None:
        """Fits what is fitted in closed form to unlabelled windows after the training, where the network has any.

        Args:
            windows (Tensor): raw states ``[*B, T, d]``; no label is read.
        """
        windows = self.normalize_state(windows)
        self.lifting.choose_size(windows)
        self.latent_action.fit_unlabelled(windows)

    @torch.no_grad()
    def fit_decoder(
        self,
        windows: TensorDictBase,
        mask: Tensor,
        *,
        groups: Tensor | None = None,
        tied_axes: Sequence[int] | None = None,
        batch_size: int = 4096,
        **kwargs,
    ) -> RidgeFit:
        """Fits the decoder in closed form on the labelled frames of windows (:meth:`LinearActionDecoder.fit_ridge`).

        Args:
            windows (TensorDictBase): states ``[*B, T, d]`` and actions ``[*B, T, act]``.
            mask (Tensor): labelled frames to use, bool ``[*B, T]``; no action outside of it is read. Frames that do
                not count in the losses (:meth:`LatentActionModule.span`) are left out.
            groups (Tensor, optional): trajectory of every window, int64 ``[*B]``, to be left out together.
            tied_axes (sequence of int, optional): the state column that each action entry moves. The decoder is then
                shrunk towards one filter of the steps that all axes share, instead of towards 0; needs a
                latent action that holds them (:attr:`LatentActionModule.holds_steps`).
            batch_size (int): windows per forward pass.
            **kwargs: options of :meth:`LinearActionDecoder.fit_ridge`.

        Returns:
            RidgeFit: the ridge chosen and its held-out error in normalised units.

        Raises:
            ValueError: if no labelled frame counts, shapes disagree, or ``tied_axes`` do not fit.
        """
        shape = windows.get(self.in_key).shape[:-1]
        if mask.shape != shape or mask.dtype != torch.bool:
            raise ValueError(f"mask must be bool {list(shape)} ([*B, T]), got {mask.dtype} {list(mask.shape)}")
        if groups is not None and groups.shape != shape[:-1]:
            raise ValueError(f"groups must be {list(shape[:-1])} ([*B]), got {list(groups.shape)}")
        span = self.latent_action.span(mask.shape[-1])
        mask = mask[..., span.start : span.stop]
        rows = mask.any(-1)
        if not rows.any():
            raise ValueError(f"no labelled frame lies in frames {span.start}..{span.stop - 1} of any window")
        states, action, mask = windows.get(self.in_key)[rows], windows.get(self.out_key)[rows], mask[rows]
        was_training = self.latent_action.training
        self.latent_action.eval()  # dropout would blur the latent actions that the decoder is fitted to
        try:
            latent = torch.cat([self.infer(part, span) for part in states.split(batch_size)])
        finally:
            self.latent_action.train(was_training)
        # unlabelled entries are zeroed before the normaliser sees them: it may refuse NaN
        action = action[:, span.start : span.stop]
        action = self.normalize_action(torch.where(mask.unsqueeze(-1), action, 0.0))
        if groups is not None:
            groups = groups[rows].unsqueeze(-1).expand_as(mask)
        if tied_axes is not None:
            kwargs["prior"] = self._tied_axis_prior(latent[mask], action[mask], tied_axes)
        return self.action_decoder.fit_ridge(latent, action, mask, groups=groups, **kwargs)

    def _tied_axis_prior(self, latent: Tensor, action: Tensor, axes: Sequence[int]) -> Tensor:
        """The decoder ``[act, m]`` that applies one and the same filter to the steps of every axis."""
        if not self.latent_action.holds_steps or len(axes) != action.shape[-1]:
            raise ValueError(
                "tied_axes need a latent action that holds steps, such as LatentActionFourier, and one state"
                f" column per action entry ({action.shape[-1]}), got {type(self.latent_action).__name__} and"
                f" {list(axes)}"
            )
        entries, factors = self.latent_action.steps(axes)  # [S, act]
        size = _unit(self.state_normalizer, self.latent_action.state_dim, factors)[list(axes)]
        action_size = _unit(self.action_normalizer, action.shape[-1], factors)
        per_unit = (factors * size).double()
        shared = fit_tied_axis_ridge(latent[:, entries].double() * per_unit, (action * action_size).double())
        prior = torch.zeros(action.shape[-1], latent.shape[-1], dtype=torch.float64, device=latent.device)
        rows = torch.arange(action.shape[-1], device=latent.device).expand_as(entries)
        prior[rows, entries] = shared[:, None] * per_unit / action_size
        return prior


def fit_tied_axis_ridge(steps: Tensor, action: Tensor, *, penalty: float = 0.02) -> Tensor:
    r"""Ridge regression with one filter that all axes share: the prior mean of a decoder that has few labels.

    .. math::
        a_{t,i} \approx \sum_s w_s v_{t,s,i} \qquad \text{for every axis } i

    with a ridge penalty relative to the mean square of the steps. A trajectory that hardly moves along one axis says
    little about that axis; together they determine the few numbers ``w`` well. A full decoder is then fitted around
    this one (``prior`` of :meth:`~torchrl_koap.modules.LinearActionDecoder.fit_ridge`).

    Args:
        steps (Tensor): steps ``v`` of each axis' own coordinate, ``[N, S, act]``, raw units.
        action (Tensor): actions ``[N, act]``, raw units.

    Keyword Args:
        penalty (float): assumed ratio of noise to signal variance. Defaults to ``0.02``.

    Returns:
        Tensor: the filter ``w`` ``[S]``.

    Raises:
        ValueError: if the axes of steps and actions differ.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.koopman.inverse_dynamics import fit_tied_axis_ridge
        >>> steps, true = torch.randn(500, 3, 2), torch.tensor([0.5, -1.0, 2.0])
        >>> found = fit_tied_axis_ridge(steps, torch.einsum("nsa,s->na", steps, true))
        >>> bool((found - true).abs().max() < 0.01)
        True
    """
    if steps.ndim != 3 or action.shape != (steps.shape[0], steps.shape[2]):
        raise ValueError(
            f"steps must be [N, S, act] and action [N, act], got {list(steps.shape)} and {list(action.shape)}"
        )
    rows, target = steps.mT.flatten(0, 1), action.flatten()  # [N * act, S]
    unit = rows.square().sum(-1).mean()
    gram = rows.mT @ rows + penalty * unit * torch.eye(rows.shape[-1], dtype=rows.dtype, device=rows.device)
    return torch.linalg.solve(gram, rows.mT @ target)


def _unit(normalizer: nn.Module | None, width: int, like: Tensor) -> Tensor:
    """Raw size of one normalised unit of every column ``[width]``."""
    if normalizer is None:
        return torch.ones(width, dtype=like.dtype, device=like.device)
    ones = torch.ones(width, dtype=like.dtype, device=like.device)
    return normalizer.inverse(ones) - normalizer.inverse(torch.zeros_like(ones))


class _Inverse(nn.Module):
    """The inverse of a normaliser, as a module whose buffers live where the normaliser's do."""

    def __init__(self, normalizer: nn.Module):
        super().__init__()
        self.normalizer = normalizer

    def forward(self, value: Tensor) -> Tensor:
        return self.normalizer.inverse(value)
