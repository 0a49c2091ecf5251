# This source code is licensed under the MIT license found in the LICENSE file.
"""Lifts high-dimensional, noisy states to few coordinates, trained in units of the measurement noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor, nn

from torchrl_koap.keys import LIFTED_STATE, STATE, read_entry
from torchrl_koap.modules.koopman.lifting import KoopmanLifting

MOST_WINDOWS = 2000  # most windows for the covariance of the noise; neighbouring windows share nearly all frames
MIN_NOISE = 0.5  # least eigenvalue of the correlation matrix of the noise; smaller estimates are raised to it
MIN_RATIO = 2.0  # components with less variance than this multiple of the noise's are left out
AVERAGED, MEANS = 5, 2000  # frames per mean, and number of means, that Isomap computes coordinates of
NEIGHBOURS, LANDMARKS = 12, 200  # initial neighbours of each point, and points from which paths are measured
COMPONENTS = 64  # largest number of components
PRETRAINING_UPDATES, PRETRAINING_RATE = 1000, 3e-3  # of the training to Isomap coordinates
BATCH = 2048  # windows that are lifted at once
GAIN = 0.7  # twice the coordinates are kept if their root mean square error is below this share of the other's


def noise_covariance(windows: Tensor) -> Tensor:
    r"""Computes the covariance of white measurement noise from the autocovariances of steps at lags 1, 2 and 3.

    For steps :math:`v_t = x_{t+1} - x_t` of a smooth motion plus noise of covariance ``R``, the noise adds ``2 R`` at
    lag 0 and ``-R`` at lag 1. A parabola in the lag through lags 2 and 3 extrapolates the motion's own autocovariance
    to lag 1. Windows are ``[N, T, d]``, ``T >= 5``; the result ``[d, d]``, float64, is positive semidefinite.
    """
    steps = windows.diff(dim=-2).double()
    lagged = []
    for lag in (1, 2, 3):
        early, late = steps[:, :-lag].flatten(0, 1), steps[:, lag:].flatten(0, 1)
        product = early.mT @ late / len(early)
        lagged.append((product + product.mT) / 2)
    curve = (lagged[1] - lagged[2]) / 5  # b of the parabola a - b lag^2
    noise = lagged[1] + 3 * curve - lagged[0]
    values, vectors = torch.linalg.eigh(noise)
    return vectors * values.clamp_min(0) @ vectors.mT


class NoiseAdjustedComponents(nn.Module):
    r"""Computes linear components of the state, ordered by their ratio of total variance to noise variance.

    .. math::
        y = \Lambda^{-1/2} U^T W^T x, \qquad W^T R W = I, \quad W^T C W = U \Lambda U^T

    with the covariance ``C`` of the states and ``R`` of the white noise in them (:func:`noise_covariance`): the minimum
    noise fraction transform (Green et al. 1988), at unit spread. The noise of a column is taken as at least 1 % of its
    spread. Components whose variance is less than twice the noise's are 0, except the first.
    """

    analysis: Tensor
    synthesis: Tensor
    weights: Tensor

    def __init__(self, state_dim: int, num_components: int):
        super().__init__()
        self.register_buffer("analysis", torch.eye(num_components, state_dim))
        self.register_buffer("synthesis", torch.eye(state_dim, num_components))
        self.register_buffer("weights", torch.ones(num_components))

    def forward(self, state: Tensor) -> Tensor:
        """Computes the components ``[*B, k]`` of states ``[*B, d]``."""
        return state @ self.analysis.mT

    def invert(self, components: Tensor) -> Tensor:
        """Maps components ``[*B, k]`` back to states ``[*B, d]``; directions without a component are 0."""
        return components @ self.synthesis.mT

    @torch.no_grad()
    def fit(self, windows: Tensor) -> None:
        """Fits the components to windows ``[*B, T >= 5, d]`` in the networks' units; no label is read."""
        windows = windows.reshape(-1, *windows.shape[-2:])
        noise = _credible(noise_covariance(windows[:: -(-len(windows) // MOST_WINDOWS)]))
        states = windows.flatten(0, -2).double()
        states = states - states.mean(0)
        total = states.mT @ states / len(states)
        # noise of at least 1 % of a column's spread (1e-4 of its variance)
        values, vectors = torch.linalg.eigh(noise.to(total) + torch.diag(1e-4 * total.diagonal() + 1e-12))
        spread = values.sqrt()
        whiten, colour = vectors / spread, vectors * spread  # inverse transposes of each other
        ratio, turn = torch.linalg.eigh(whiten.mT @ total @ whiten)
        count = len(self.weights)
        ratio, turn = ratio[-count:].flip(-1), turn[:, -count:].flip(-1)
        analysis, synthesis = (whiten @ turn).mT, colour @ turn
        sign = torch.where(analysis.sum(-1) < 0, -1.0, 1.0)  # the sign of an eigenvector is arbitrary
        kept = ratio > MIN_RATIO
        kept[0] = True
        size = torch.where(ratio > 1e-9, ratio.sqrt(), 1.0)
        self.analysis.copy_(analysis * (sign * kept / size)[:, None])
        self.synthesis.copy_(synthesis * (sign * kept * size))
        self.weights.copy_(torch.where(kept, ratio, 0.0) * count / ratio[kept].sum().clamp_min(1e-9))


def _credible(noise: Tensor) -> Tensor:
    """Raises small eigenvalues of an estimated noise covariance ``[d, d]``, which few windows make too small by chance.

    With many columns this nearly always occurs, and such directions would become the first components.
    """
    spread = noise.diagonal().clamp_min(1e-12).sqrt()
    values, vectors = torch.linalg.eigh(noise / spread / spread[:, None])
    return vectors * values.clamp_min(MIN_NOISE) @ vectors.mT * spread * spread[:, None]


@torch.no_grad()
def isomap(points: Tensor, dims: int) -> Tensor:
    r"""Computes Isomap coordinates, whose Euclidean distances approximate distances along the surface of the data.

    .. math::
        z_i = -\tfrac12\, \Lambda^{-1/2} V^T (D^2_{i} - \overline{D^2})

    with the shortest paths ``D`` from the point to the landmarks over a graph of nearest neighbours, and the leading
    eigenvalues and -vectors of the landmarks' doubly centred squared distances: Isomap (Tenenbaum et al. 2000) with
    landmarks (de Silva and Tenenbaum 2003). The number of neighbours is doubled until the graph is connected.

    The first 200 of the points ``[N, d]`` are the landmarks, so points should be in random order. Coordinates
    ``[N, dims]`` have unit spread, those with the widest spread before scaling come first; those that landmarks do not
    span are 0.
    """
    chosen = min(LANDMARKS, len(points))
    ways = _shortest_ways(points.double(), chosen) ** 2  # [landmarks, N]
    own = ways[:, :chosen]
    centred = own - own.mean(0) - own.mean(1, keepdims=True) + own.mean()
    values, vectors = np.linalg.eigh(-centred / 2)
    count = min(dims, chosen)
    values, vectors = values[-count:][::-1], vectors[:, -count:][:, ::-1]
    spanned = values > 1e-9 * values[0]
    vectors = vectors * np.where(vectors.sum(0) < 0, -1.0, 1.0) * spanned  # their sign is arbitrary
    factor = np.sqrt(np.where(spanned, values, 1.0))
    coordinates = -((ways - own.mean(1, keepdims=True)).T @ vectors) / (2 * factor)
    spread = coordinates.std(0)
    coordinates = (coordinates - coordinates.mean(0)) / np.where(spread > 1e-12, spread, 1.0)
    return torch.nn.functional.pad(torch.from_numpy(coordinates), (0, dims - count)).to(points)


def _shortest_ways(points: Tensor, landmarks: int) -> np.ndarray:
    """Computes the lengths ``[landmarks, N]`` of the shortest paths in the graph from the first points to all."""
    distances, count, neighbours = torch.cdist(points, points), len(points), NEIGHBOURS
    while True:
        near, index = distances.topk(min(neighbours + 1, count), largest=False)
        row = torch.arange(count)[:, None].expand_as(index)
        near = near.clamp_min(1e-12)  # equal points stay neighbours, at a positive distance
        graph = csr_matrix((near.flatten().cpu(), (row.flatten(), index.flatten().cpu())), shape=(count, count))
        if connected_components(graph, directed=False)[0] == 1:
            return dijkstra(graph, directed=False, indices=np.arange(landmarks))
        neighbours *= 2


class CompactLifting(TensorDictModuleBase):
    r"""Lifts high-dimensional states to few coordinates; decides without labels whether twice as many are needed.

    .. math::
        y = P x, \quad z = (g_1(y), g_2(y)), \quad
        L_{recon} = \tfrac12 \sum_{i=1}^{2} \overline{w\, |h_i(g_i(y)) - y|^2}

    ``P`` are the :class:`NoiseAdjustedComponents` and ``w`` their variances in units of the noise. ``g_1`` has ``m``
    ``coordinates`` and ``g_2`` twice as many; both are trained. :meth:`finish` keeps the smaller one unless the larger
    one has less than 70 % of its root mean square error, for example because objects move independently of the robot.
    Coordinates of the network that is not kept are 0.

    States are ``[*B, T, d]``, lifted ones ``[*B, T, 3 m]``; ``hidden_dims`` are the widths of all networks.
    """

    kept: Tensor
    keeps_state = False  # the lifted state does not contain the state

    def __init__(
        self,
        state_dim: int,
        coordinates: int,
        *,
        hidden_dims: Sequence[int] = (128, 128),
        in_key: NestedKey = STATE,
        out_key: NestedKey = LIFTED_STATE,
    ):
        super().__init__()
        self.in_keys, self.out_keys = [in_key], [out_key]
        self.state_dim, self.coordinates, self.latent_dim = state_dim, coordinates, 3 * coordinates
        self.components = NoiseAdjustedComponents(state_dim, min(COMPONENTS, state_dim))
        count = len(self.components.weights)
        self.small = KoopmanLifting(count, coordinates, hidden_dims=hidden_dims, linear_skip=True)
        self.large = KoopmanLifting(count, 2 * coordinates, hidden_dims=hidden_dims, linear_skip=True)
        self.register_buffer("kept", torch.ones(self.latent_dim))

    def encode(self, state: Tensor) -> Tensor:
        """Lifts states ``[*B, T, d]`` to ``[*B, T, 3 m]``; coordinates that were not chosen are 0."""
        if state.shape[-1] != self.state_dim:
            raise ValueError(f"expected states with {self.state_dim} columns, got shape {list(state.shape)}")
        components = self.components(state)
        return torch.cat([self.small.encode(components), self.large.encode(components)], -1) * self.kept

    def _decoded(self, lifted: Tensor) -> tuple[Tensor, Tensor]:
        small, large = lifted.split([self.coordinates, 2 * self.coordinates], -1)
        return self.small.decode(small), self.large.decode(large)

    def decode(self, lifted: Tensor) -> Tensor:
        """Maps lifted states ``[*B, T, 3 m]`` back to ``[*B, T, d]``."""
        small, large = self._decoded(lifted)
        share = self.kept[[0, -1]] / self.kept[[0, -1]].sum()
        return self.components.invert(share[0] * small + share[1] * large)

    def reconstruction_error(self, lifted: Tensor, state: Tensor) -> Tensor:
        """Computes the squared error ``[*B, T]`` of components, weighted by their variance in units of the noise."""
        target = self.components(state)
        errors = [((made - target).square() * self.components.weights).mean(-1) for made in self._decoded(lifted)]
        return (errors[0] + errors[1]) / 2

    @torch.no_grad()
    def prepare(self, windows: Tensor) -> None:
        """Fits the components to windows ``[*B, T, d]``; the first initialise the linear part of both networks."""
        self.kept.fill_(1.0)
        self.components.fit(windows)
        components, size = self.components(windows), self.components.weights.sqrt()
        for network in (self.small, self.large):
            network.prepare(components * size)
            network.encoder_skip.weight.mul_(size)
            network.decoder_skip.weight.mul_(torch.where(size > 0, 1 / size.clamp_min(1e-6), 0.0)[:, None])

    @torch.enable_grad()
    def pretrain(self, windows: Tensor, updates: int, progress: Callable[[int, int], None] | None = None) -> None:
        """Trains both networks, before any loss, to map components to Isomap coordinates and back.

        Gradients of the losses do not unfold a folded surface. :func:`isomap` is computed on means of a few successive
        frames, which are less noisy. Windows have 5 frames or more; each network takes at most 1000 updates.
        """
        updates, windows = min(updates, PRETRAINING_UPDATES), windows.reshape(-1, *windows.shape[-2:])
        weights, components = self.components.weights, self.components(windows).detach()
        spans = components.unfold(1, AVERAGED, AVERAGED).flatten(0, 1)  # [N, k, AVERAGED]
        chosen = torch.randperm(len(spans), generator=torch.Generator().manual_seed(0))[:MEANS]
        spans = spans[chosen.to(spans.device)]
        components = spans[..., AVERAGED // 2]
        wanted = isomap(spans.mean(-1) * weights.sqrt(), 2 * self.coordinates)
        for number, (network, size) in enumerate(((self.small, self.coordinates), (self.large, 2 * self.coordinates))):
            target, parameters = wanted[:, :size], list(network.parameters())
            optimizer = torch.optim.Adam(parameters, lr=PRETRAINING_RATE)
            schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, PRETRAINING_RATE, total_steps=updates + 1)
            for done in range(1, updates + 1):
                optimizer.zero_grad()
                there = (network.encode(components) - target).square().mean()
                back = ((network.decode(target) - components).square() * weights).mean()
                (there + back).backward()
                optimizer.step()
                schedule.step()
                if progress is not None:
                    progress(number * updates + done, 2 * updates)
            optimizer.zero_grad()

    @torch.no_grad()
    def finish(self, windows: Tensor) -> None:
        """Chooses, after training, one network by the reconstruction errors of both on windows ``[*B, T, d]``."""
        sums = torch.zeros(2, dtype=torch.float64)
        for part in windows.reshape(-1, *windows.shape[-2:]).split(BATCH):
            target = self.components(part)
            for index, made in enumerate(self._decoded(self.encode(part))):
                sums[index] += ((made - target).square() * self.components.weights).sum().double().cpu()
        large = bool(sums[1].sqrt() < GAIN * sums[0].sqrt())
        self.kept[: self.coordinates], self.kept[self.coordinates :] = float(not large), float(large)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the lifted states."""
        return tensordict.set(self.out_keys[0], self.encode(read_entry(self, tensordict, self.in_keys[0])))
