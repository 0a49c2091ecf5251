# This source code is licensed under the MIT license found in the LICENSE file.
"""Linear algebra on symmetric 6 x 6 matrices, compiled: the inverse kinematics solves one every millisecond.

LAPACK through numba allocates and takes the interpreter lock; these few loops do neither.
"""

from __future__ import annotations

import numpy as np
from numba import njit

EIGENVALUE_MIN, EIGENVALUE_MAX = 0.01, 100.0


@njit(cache=True)
def clip(value, low, high):
    """Returns the value, or the bound that it lies beyond."""
    return min(max(value, low), high)


@njit(cache=True)
def _cholesky(matrix, shift, factor):
    """Lower Cholesky factor of ``matrix - shift * I``; False if that is not positive definite."""
    for i in range(6):
        for j in range(i + 1):
            total = matrix[i, j] - (shift if i == j else 0.0)
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                factor[i, i] = np.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
    return True


@njit(cache=True)
def solve_clipped(matrix, rhs, factor, vectors):
    """Solves ``A x = b`` in place for symmetric ``A`` whose eigenvalues are clipped to [0.01, 100] first.

    Clipping is rarely active. Two cheap tests say so: ``A - 0.01 I`` has a Cholesky factor, and the trace is below 100.

    Args:
        matrix (np.ndarray): ``A`` [6, 6]; destroyed where eigenvalues have to be clipped.
        rhs (np.ndarray): ``b`` [6], overwritten by ``x``.
        factor (np.ndarray): scratch space [6, 6].
        vectors (np.ndarray): scratch space [6, 6].
    """
    trace = 0.0
    for i in range(6):
        trace += matrix[i, i]
    if trace <= EIGENVALUE_MAX and _cholesky(matrix, EIGENVALUE_MIN, factor):
        _cholesky(matrix, 0.0, factor)
        for i in range(6):
            for k in range(i):
                rhs[i] -= factor[i, k] * rhs[k]
            rhs[i] /= factor[i, i]
        for i in range(5, -1, -1):
            for k in range(i + 1, 6):
                rhs[i] -= factor[k, i] * rhs[k]
            rhs[i] /= factor[i, i]
        return
    _diagonalise(matrix, vectors)
    for j in range(6):
        total = 0.0
        for i in range(6):
            total += vectors[i, j] * rhs[i]
        factor[0, j] = total / clip(matrix[j, j], EIGENVALUE_MIN, EIGENVALUE_MAX)
    for i in range(6):
        rhs[i] = 0.0
        for j in range(6):
            rhs[i] += vectors[i, j] * factor[0, j]


@njit(cache=True)
def _diagonalise(matrix, vectors):
    """Cyclic Jacobi rotations: ``matrix`` becomes diagonal, the columns of ``vectors`` are the eigenvectors."""
    for i in range(6):
        for j in range(6):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(30):
        off, diagonal = 0.0, 0.0
        for i in range(6):
            diagonal += matrix[i, i] ** 2
            for j in range(i):
                off += matrix[i, j] ** 2
        if off <= 1e-32 * diagonal:
            break
        for p in range(5):
            for r in range(p + 1, 6):
                if matrix[p, r] == 0.0:
                    continue
                theta = (matrix[r, r] - matrix[p, p]) / (2.0 * matrix[p, r])
                t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(6):
                    a, b = matrix[k, p], matrix[k, r]
                    matrix[k, p], matrix[k, r] = c * a - s * b, s * a + c * b
                for k in range(6):
                    a, b = matrix[p, k], matrix[r, k]
                    matrix[p, k], matrix[r, k] = c * a - s * b, s * a + c * b
                for k in range(6):
                    a, b = vectors[k, p], vectors[k, r]
                    vectors[k, p], vectors[k, r] = c * a - s * b, s * a + c * b
