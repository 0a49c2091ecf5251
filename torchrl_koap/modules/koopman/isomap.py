# This source code is licensed under the MIT license found in the LICENSE file.
"""Isomap: coordinates along the curved surface that points lie on, from distances between neighbours."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from torch import Tensor


@torch.no_grad()
def isomap(points: Tensor, dims: int, *, neighbours: int = 12, landmarks: int = 200) -> Tensor:
    r"""Computes coordinates whose straight distances are those along the surface, as nearly as so many can be.

    .. math::
        z_i = -\tfrac12\, \Lambda^{-1/2} V^T (D^2_{i} - \overline{D^2})

    with the shortest ways ``D`` from the point to the landmarks over a graph of nearest neighbours, and the leading
    eigenvalues and -vectors of the landmarks' doubly centred squared distances: Isomap (Tenenbaum et al. 2000) with
    landmarks (de Silva and Tenenbaum 2003). Where the graph falls apart it gets more neighbours until it does not.

    Args:
        points (Tensor): ``[N, d]``; the first ``landmarks`` of them are the landmarks, so they should be in no order.
        dims (int): number ``m`` of coordinates. Those that the landmarks do not span are 0.

    Keyword Args:
        neighbours (int): nearest points that each is joined to. Defaults to ``12``.
        landmarks (int): points from which ways are measured. Defaults to ``200``.

    Returns:
        Tensor: ``[N, m]``, the one of widest spread first, each at unit spread.

    Raises:
        ValueError: for less than two points.
    """
    if len(points) < 2:
        raise ValueError(f"coordinates along a surface need at least two points, got {len(points)}")
    chosen = min(landmarks, len(points))
    ways = _shortest_ways(points.double(), neighbours, chosen) ** 2  # [landmarks, N]
    own = ways[:, :chosen]
    centred = own - own.mean(0) - own.mean(1, keepdims=True) + own.mean()
    values, vectors = np.linalg.eigh(-centred / 2)
    count = min(dims, chosen)
    values, vectors = values[-count:][::-1], vectors[:, -count:][:, ::-1]
    spanned = values > 1e-9 * values[0]
    vectors = vectors * np.where(vectors.sum(0) < 0, -1.0, 1.0) * spanned  # their sign is the solver's whim
    factor = np.sqrt(np.where(spanned, values, 1.0))
    coordinates = -((ways - own.mean(1, keepdims=True)).T @ vectors) / (2 * factor)
    spread = coordinates.std(0)
    coordinates = (coordinates - coordinates.mean(0)) / np.where(spread > 1e-12, spread, 1.0)
    return torch.nn.functional.pad(torch.from_numpy(coordinates), (0, dims - count)).to(points)


def _shortest_ways(points: Tensor, neighbours: int, landmarks: int) -> np.ndarray:
    """Lengths ``[landmarks, N]`` of the shortest ways over the graph, from the first points to all."""
    distances, count = torch.cdist(points, points), len(points)
    while True:
        near, index = distances.topk(min(neighbours + 1, count), largest=False)
        row = torch.arange(count)[:, None].expand_as(index)
        near = near.clamp_min(1e-12)  # points that coincide are neighbours too
        graph = csr_matrix((near.flatten().cpu(), (row.flatten(), index.flatten().cpu())), shape=(count, count))
        if connected_components(graph, directed=False)[0] == 1:
            return dijkstra(graph, directed=False, indices=np.arange(landmarks))
        neighbours *= 2
