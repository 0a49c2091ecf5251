# This source code is licensed under the MIT license found in the LICENSE file.
"""The linear decoder from latent actions to robot actions, trained by gradients or fitted in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_koap.keys import ACTION, LATENT_ACTION
from torchrl_koap.modules.koopman.held_out_errors import held_out_errors, thin_svd

# latent actions larger than this keep so many directions of their covariance: a square root of it would be gigabytes
WIDE, DIRECTIONS = 2048, 256
# variance of the errors of plans that recorded steps do not show, in units of a latent action's mean square norm: where
# thousands of steps are labelled, a penalty chosen by them alone was followed by fewer successes in closed loop
INPUT_NOISE = 1e-8


@dataclass(frozen=True)
class RidgeFit:
    """What :meth:`LinearActionDecoder.fit_ridge` found.

    Args:
        penalty (float): the ridge, in units of the mean square norm of the latent actions.
        errors (dict): root of the mean squared held-out error of every candidate, in the units of the targets.
        num_labels (int): labelled steps used.
        noise_variance (Tensor): held-out residual variance per action dimension ``[act]``.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import LinearActionDecoder
        >>> latent = torch.randn(50, 4)
        >>> fit = LinearActionDecoder(4, 2).fit_ridge(latent, latent[:, :2], torch.ones(50, dtype=torch.bool))
        >>> fit.num_labels, fit.noise_variance.shape, fit.penalty in fit.errors
        (50, torch.Size([2]), True)
    """

    penalty: float
    errors: dict[float, float]
    num_labels: int
    noise_variance: Tensor


class LinearActionDecoder(TensorDictModuleBase):
    r"""Decodes latent actions linearly.

    .. math::
        a_t = D u_t + b

    Args:
        latent_dim (int): size ``m`` of a latent action.
        action_dim (int): size of an action.

    Keyword Args:
        in_key (NestedKey): latent actions ``[*B, T, m]``. Defaults to ``"latent_action"``.
        out_key (NestedKey): actions ``[*B, T, act]``. Defaults to ``"action"``.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import LinearActionDecoder
        >>> latent, true = torch.randn(200, 4), torch.randn(2, 4)
        >>> decoder = LinearActionDecoder(4, 2)
        >>> fit = decoder.fit_ridge(latent, latent @ true.T, torch.ones(200, dtype=torch.bool))
        >>> bool((decoder.linear.weight - true).abs().max() < 1e-3), fit.num_labels
        (True, 200)
    """

    covariance_root: Tensor
    noise_variance: Tensor
    latent_mean: Tensor
    mean_leverage: Tensor

    def __init__(
        self, latent_dim: int, action_dim: int, *, in_key: NestedKey = LATENT_ACTION, out_key: NestedKey = ACTION
    ):
        super().__init__()
        self.in_keys, self.out_keys = [in_key], [out_key]
        self.linear = nn.Linear(latent_dim, action_dim)
        self.is_wide = latent_dim > WIDE
        width = DIRECTIONS if self.is_wide else latent_dim
        self.register_buffer("covariance_root", torch.full((latent_dim, width), torch.nan))
        self.register_buffer("noise_variance", torch.full((action_dim,), torch.nan))
        self.register_buffer("latent_mean", torch.zeros(latent_dim))
        self.register_buffer("mean_leverage", torch.zeros(()))
        if self.is_wide:  # variance of the directions that no label determines
            self.register_buffer("prior_variance", torch.zeros(()))

    def forward(self, tensordict):
        """Writes the decoded actions."""
        return tensordict.set(self.out_keys[0], self.linear(tensordict.get(self.in_keys[0])))

    @torch.no_grad()
    def fit_ridge(
        self,
        latent: Tensor,
        action: Tensor,
        mask: Tensor,
        *,
        groups: Tensor | None = None,
        penalties: Sequence[float] = tuple(10.0 ** (p / 2) for p in range(-12, 3)),
        default_penalty: float | None = None,
        input_noise: float = 0.0,
        bias: bool = True,
        prior: Tensor | None = None,
    ) -> RidgeFit:
        r"""Sets ``D`` and ``b`` by ridge regression on frozen latent actions.

        The penalty is chosen by leaving out one step at a time, :math:`e_i = (a_i - \hat a_i) / (1 - h_i)` with the
        leverage ``h_i``, which is exact for least squares. With ``groups`` all steps of a group are left out together
        (exact as well): steps of one trajectory resemble each other so much that leaving out one says little.

        Steps that are left out are recorded ones too. Latent actions of *plans* have errors besides, which many labels
        do not show: the more there are, the smaller the penalty that is chosen, and the more a direction counts in
        which recorded steps hardly differ. Noise of variance :math:`s^2` on every entry acts as a penalty of
        :math:`n s^2` (Bishop 1995, "Training with noise is equivalent to Tikhonov regularization"), so no smaller one
        is chosen.

        Args:
            latent (Tensor): latent actions ``[*B, m]``.
            action (Tensor): actions ``[*B, act]``; anything, NaN included, where ``mask`` is False.
            mask (Tensor): labelled steps, bool ``[*B]``.
            groups (Tensor, optional): group of every step, int64 ``[*B]``.
            penalties (sequence of float): candidates, in units of the mean square norm of the latent actions: the ratio
                of noise to signal variance that the fit assumes.
            default_penalty (float, optional): used instead of the choice where there are fewer than three groups.
            input_noise (float): variance :math:`s^2` of the errors of every entry of latent actions to come, in units
                of their mean square norm. Defaults to 0.
            bias (bool): fit ``b``; otherwise it is 0 and a latent action of 0 decodes to 0. Defaults to ``True``.
            prior (Tensor, optional): ``[act, m]``, what ``D`` is shrunk towards. Defaults to 0.

        Returns:
            RidgeFit: the choice and its held-out errors; they are infinite where a single step leaves nothing to fit
                the mean to.

        Raises:
            ValueError: if nothing is labelled, a labelled action or latent action is not finite, a penalty is not
                positive, or shapes disagree.
        """
        if mask.dtype != torch.bool:
            raise ValueError(f"mask must be bool, got {mask.dtype}")
        if latent.shape[:-1] != action.shape[:-1] or mask.shape != latent.shape[:-1]:
            raise ValueError(
                f"latent {list(latent.shape)}, action {list(action.shape)} and mask {list(mask.shape)} must share"
                " their leading shape"
            )
        if groups is not None and groups.shape != mask.shape:
            raise ValueError(f"groups must have the shape of mask {list(mask.shape)}, got {list(groups.shape)}")
        candidates = tuple(penalties) if default_penalty is None else (*penalties, default_penalty)
        if not candidates or not all(0 < penalty < float("inf") for penalty in candidates):
            raise ValueError(f"penalties must be positive and finite, got {candidates}")
        if not 0 <= input_noise < float("inf"):
            raise ValueError(f"input_noise must be finite and not negative, got {input_noise}")
        if not mask.any():
            raise ValueError("fit_ridge needs at least one labelled step, the mask selects none")
        x, y = latent[mask].double(), action[mask].double()
        if not y.isfinite().all():
            raise ValueError("fit_ridge got a labelled action that is not finite")
        if not x.isfinite().all():
            raise ValueError("fit_ridge got a latent action that is not finite")
        prior = torch.zeros(y.shape[-1], x.shape[-1]) if prior is None else prior
        if prior.shape != self.linear.weight.shape:
            raise ValueError(f"prior must be {list(self.linear.weight.shape)}, got {list(prior.shape)}")
        prior = prior.to(x)
        y = y - x @ prior.mT  # a ridge around the prior is a ridge around 0 on what the prior leaves over
        rows = torch.arange(len(x), device=x.device)
        groups = rows if groups is None else groups[mask].unique(return_inverse=True)[1]
        num_groups = int(groups.max()) + 1
        if default_penalty is not None and num_groups < 3:
            penalties = (default_penalty,)
        if num_groups == 1:  # its steps are all there is to leave out
            groups = rows

        mean_x, mean_y = (x.mean(0), y.mean(0)) if bias else (torch.zeros_like(x[0]), torch.zeros_like(y[0]))
        centred, target = (x - mean_x, y - mean_y) if bias else (x, y)  # a copy may take gigabytes
        left, singular, right = thin_svd(centred, wide=WIDE)
        unit = centred.square().sum(-1).mean()
        unit = torch.where(unit > 0, unit, torch.ones_like(unit))  # constant latent actions: any scale will do
        projected = left.mT @ target

        least = input_noise * len(x)
        tried = sorted({max(float(penalty), least) for penalty in penalties})
        shrinks = torch.stack([singular.square() / (singular.square() + penalty * unit) for penalty in tried])
        squares = held_out_errors(left, shrinks, target, groups, centred=bias)
        errors = dict(zip(tried, squares.mean(-1).sqrt().tolist(), strict=True))
        best = min(errors, key=errors.get)
        scaled = singular.square() + best * unit
        weight = (right.mT * (singular / scaled)) @ projected  # [m, act]
        self.linear.weight.copy_(prior + weight.mT)
        self.linear.bias.copy_(mean_y - mean_x @ weight)
        self.noise_variance.copy_(squares[tried.index(best)])
        # a root, column by column along the singular directions: in float32 the covariance itself would drown the
        # well-determined directions (1e-4) in the rounding of the undetermined ones (1e6)
        if self.is_wide:
            kept = min(DIRECTIONS, len(right))
            known = (1 / (best * unit) - 1 / scaled[:kept]).clamp_min(0).sqrt()
            self.covariance_root.zero_()[:, :kept] = (right[:kept].mT * known).to(self.covariance_root)
            self.prior_variance.copy_(1 / (best * unit))
        else:
            missing = torch.linalg.svd(right, full_matrices=True)[2][len(right) :]  # [m - r, m]
            basis = torch.cat([right, missing])
            spectrum = torch.cat([scaled, (best * unit).expand(len(missing))])
            self.covariance_root.copy_(basis.mT / spectrum.sqrt())
        self.latent_mean.copy_(mean_x)
        self.mean_leverage.fill_(1 / len(x) if bias else 0.0)
        return RidgeFit(best, errors, len(x), self.noise_variance.clone())

    def predictive_variance(self, latent: Tensor) -> Tensor:
        r"""Variance of a predicted action.

        .. math::
            \sigma^2 (1 + 1/n + (u - \bar u)^T (\bar U^T \bar U + \lambda)^{-1} (u - \bar u))

        with the ``n`` centred latent actions :math:`\bar U` of the fit: the noise, the uncertainty of ``b`` (left out
        with ``bias=False``) and that of ``D``.

        Args:
            latent (Tensor): latent actions ``[*B, m]``.

        Returns:
            Tensor: variances ``[*B, act]``, in the squared units of the fitted targets.

        Raises:
            RuntimeError: if the decoder was not fitted in closed form.
        """
        if self.covariance_root.isnan().any():
            raise RuntimeError("predictive_variance needs a decoder fitted by fit_ridge()")
        centred = latent - self.latent_mean
        leverage = (centred @ self.covariance_root).square().sum(-1, keepdim=True)
        if self.is_wide:  # what labels say about the kept directions is taken off the prior's variance
            prior = self.prior_variance * centred.square().sum(-1, keepdim=True)
            leverage = (prior - leverage).clamp_min(0)
        return (1 + self.mean_leverage + leverage) * self.noise_variance
