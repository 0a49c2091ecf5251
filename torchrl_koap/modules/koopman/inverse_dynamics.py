# This source code is licensed under the MIT license found in the LICENSE file.
"""The Koopman inverse dynamics model, which maps windows of states to latent actions and robot actions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_koap.modules.inverse_dynamics import LatentInverseDynamics
from torchrl_koap.modules.koopman.compact_lifting import CompactLifting
from torchrl_koap.modules.koopman.latent_action import LatentActionModule, LinearActionDecoder
from torchrl_koap.modules.koopman.lifting import KoopmanLifting, KoopmanOperator
from torchrl_koap.modules.ridge import DEFAULT_PENALTY, INPUT_NOISE, RidgeFit, SharedFilter, ridge
from torchrl_koap.modules.windows import WindowReader


class LiftedInverseDynamics(LatentInverseDynamics):
    """Base class of the models that ``KOAPLoss`` trains: lifted states ``z = g(x)``, with latent actions as input.

    A subclass defines their dynamics (:meth:`predict_next`). Arguments as for :class:`KoopmanInverseDynamics`.
    """

    def __init__(
        self,
        latent_action: LatentActionModule,
        action_decoder: nn.Module,
        lifting: KoopmanLifting | CompactLifting,
        **kwargs,
    ):
        super().__init__(None, action_decoder, **kwargs)
        self.latent_action, self.lifting = latent_action, lifting

    @property
    def reader(self) -> WindowReader:  # type: ignore[override]
        """The reader of the network ``f``."""
        return self.latent_action.reader

    def lift(self, state: Tensor) -> Tensor:
        """Lifts raw states ``[*B, T, d]`` to ``[*B, T, m]``."""
        return self.lifting.encode(self.normalize_state(state))

    def infer(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Infers the latent actions ``[*B, len(frames), p]`` of a window of raw states ``[*B, T, d]``."""
        return self.latent_action.infer(self.latent_action.gather(self.normalize_state(state), frames))

    def predict_next(self, lifted: Tensor, latent_action: Tensor) -> Tensor:
        """Predicts ``z_{t+1}`` of lifted states ``[*B, T, m]`` and latent actions ``[*B, T, p]``."""
        raise NotImplementedError


class KoopmanInverseDynamics(LiftedInverseDynamics):
    r"""Infers latent actions from a window of states and decodes them linearly to robot actions.

    Normalises, infers :math:`u_t = f_\theta(\cdot)`, decodes :math:`a_t = D u_t + b` and de-normalises. Lifting and
    operator are used only in training, where :math:`z_{t+1} = K z_t + u_t` shapes the latent actions.

    The parts are TensorDictModules themselves, and each occurs once in the state dict. They read and write the entries
    that they were made with, in the networks' units. The model does not call their ``forward``: a subclass of a part
    overrides ``encode`` and ``decode`` (lifting), ``infer`` (latent action) or ``step`` (operator). For another decoder
    override :meth:`decode` of the model.

    Args:
        latent_action (LatentActionModule): the network ``f``.
        action_decoder (LinearActionDecoder): the decoder ``D``.

    Keyword Args:
        lifting (KoopmanLifting or CompactLifting): the networks ``g``.
        operator (KoopmanOperator): the matrix ``K``.
        penalty (float): ridge penalty of the decoder if fewer than three trajectories have labels. Default: ``0.15``.
        input_noise (float): variance of the errors of plans, in units of the mean square norm of latent actions; it
            bounds the penalty from below, see :func:`~torchrl_koap.modules.ridge.ridge`. Default: ``1e-8``.
        **kwargs: normalisers, see :class:`~torchrl_koap.modules.InverseDynamics`.

    Raises:
        TypeError: if the decoder is no LinearActionDecoder.
        ValueError: if sizes of the parts differ.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import make_koopman_inverse_dynamics
        >>> model = make_koopman_inverse_dynamics(2, 2, preset="paper", latent_dim=16, hidden_dim=32)
        >>> td = model(TensorDict({"state": torch.randn(3, 16, 2)}, [3]))
        >>> td["action"].shape, td["latent_action"].shape
        (torch.Size([3, 16, 2]), torch.Size([3, 16, 16]))
    """

    action_decoder: LinearActionDecoder

    def __init__(
        self,
        latent_action: LatentActionModule,
        action_decoder: nn.Module,
        *,
        lifting: KoopmanLifting | CompactLifting,
        operator: KoopmanOperator,
        penalty: float = DEFAULT_PENALTY,
        input_noise: float = INPUT_NOISE,
        **kwargs,
    ):
        if not isinstance(action_decoder, LinearActionDecoder):
            wanted, got = "a LinearActionDecoder; for another map override decode()", type(action_decoder).__name__
            raise TypeError(f"action_decoder must be {wanted}; got {got}")
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
        super().__init__(latent_action, action_decoder, lifting, **kwargs)
        self.out_keys = [*latent_action.out_keys, self.out_key]
        self.latent_key = latent_action.out_keys[0]
        self.operator, self.penalty, self.input_noise = operator, penalty, input_noise

    def decode(self, latent: Tensor) -> Tensor:
        """Decodes latent actions ``[*B, T, m]`` to actions ``[*B, T, act]`` in normalised units."""
        return self.action_decoder.linear(latent)

    def predict_next(self, lifted: Tensor, latent_action: Tensor) -> Tensor:
        """Predicts ``z_{t+1} = K z_t + u_t``, or with ``B u_t``."""
        return self.operator.step(lifted, latent_action)

    def prepare(self, windows: Tensor, *, updates: int = 0, progress: Callable[[int, int], None] | None = None) -> None:
        """Fits statistics of the inputs before training, and trains a :class:`CompactLifting` to Isomap coordinates.

        With ``updates=0`` this lifting starts at linear components.
        """
        windows = self.normalize_state(windows)
        with torch.no_grad():
            self.lifting.prepare(windows)
            self.latent_action.prepare(windows)
        if updates:
            self.lifting.pretrain(windows, updates, progress)

    @torch.no_grad()
    def finish(self, windows: Tensor) -> None:
        """Fits lifting and latent action after training, to raw states ``[*B, T, d]``."""
        windows = self.normalize_state(windows)
        self.lifting.finish(windows)
        self.latent_action.finish(windows)

    @torch.no_grad()
    def fit_labels(
        self,
        windows: TensorDictBase,
        mask: Tensor,
        *,
        axes: Sequence[int] = (),
        guessed: bool = False,
        alike: bool = True,
    ) -> dict[str, Any]:
        """Fits the decoder in closed form; of a latent action with several blocks it chooses one.

        With ``axes``, and a latent action that contains the steps along them, the decoder is shrunk towards one filter
        of the steps that all axes share, instead of towards 0. Guessed axes are used only if they lower the held-out
        error. The summary names the ``block`` if there were several.
        """
        network, normalizer = self.latent_action, self.action_normalizer
        options = {
            "default_penalty": self.penalty,
            "input_noise": self.input_noise,
            "bias": normalizer is not None and bool(normalizer.offset.any()),
            "alike": alike,
        }
        was_training, chosen, fits = self.training, deepcopy(network.state_dict()), {}
        self.eval()
        try:
            for block in network.blocks:
                network.choose(block)
                inputs, action, groups = self.labelled_frames(self.infer, windows, mask)
                fits[block] = self._fit_decoder(inputs, action, axes, guessed, groups=groups, **options)
                if (0 if groups is None else len(groups.unique())) < network.min_trajectories:
                    break
        finally:
            network.load_state_dict(chosen)  # the decoder belongs to this block until it is replaced
            self.train(was_training)
        best = network.best_block({block: fit.error for block, fit in fits.items()})
        self.action_decoder.assign(fits[best])
        network.choose(best)
        return fits[best].summary() | ({"block": best} if len(network.blocks) > 1 else {})

    def _fit_decoder(
        self, latent: Tensor, action: Tensor, axes: Sequence[int], guessed: bool, **options: Any
    ) -> RidgeFit:
        """Fits with the shared filter of the axes as prior."""
        features = self.latent_action.axis_features(axes) if axes else None
        if features is None:
            return ridge(latent, action, **options)
        if len(axes) != action.shape[-1]:
            raise ValueError(f"axes must be one state column per action entry ({action.shape[-1]}), got {list(axes)}")
        prior = self._shared_filter(latent.shape[-1], axes, *features)
        return ridge(latent, action, prior=prior, guessed=guessed, **options)

    def _shared_filter(self, latent_dim: int, axes: Sequence[int], entries: Tensor, factors: Tensor) -> SharedFilter:
        """Returns the filter of the steps of every axis, with a decoder ``[act, m]`` for each of its ``S`` weights."""
        size = _unit(self.state_normalizer, self.latent_action.state_dim, factors)[list(axes)]
        action_size = _unit(self.action_normalizer, len(axes), factors).double()
        basis = torch.zeros(*entries.shape, latent_dim, dtype=torch.float64, device=entries.device)
        per_unit = (factors * size).double() / action_size
        return SharedFilter(basis.scatter_(-1, entries[..., None], per_unit[..., None]), action_size)


def _unit(normalizer: nn.Module | None, width: int, like: Tensor) -> Tensor:
    """Returns the raw size of one normalised unit of every column, ``[width]``."""
    ones = torch.ones(width, dtype=like.dtype, device=like.device)
    return ones if normalizer is None else normalizer.inverse(ones) - normalizer.inverse(torch.zeros_like(ones))
