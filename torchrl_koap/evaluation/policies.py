# This source code is licensed under the MIT license found in the LICENSE file.
"""Makes policies from finished trainings, optionally with an inverse of the simulator as controller."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchrl_koap.evaluation.oracle import OracleFollower
from torchrl_koap.modules import Execution, ExecutionConfig, PlanningPolicy
from torchrl_koap.training.trained import Trained


def load_policy(
    where: str | Path | Trained, *, device: str = "cpu", plugins: Sequence[str] = (), **asked: Any
) -> PlanningPolicy:
    """Makes a policy from a run, or from a file of :meth:`Trained.save`: observations in, an action per step out.

    A :class:`~torchrl_koap.modules.PolicyEnv` provides the entries that it reads; so does an
    :class:`~torchrl_koap.modules.Agent`.

    Args:
        where (str, Path or Trained): a run directory, ``"pretrained:NAME"``, a file, or the result of
            :func:`~torchrl_koap.fit`.

    Keyword Args:
        device (str): ``"cpu"`` or ``"cuda"``.
        plugins (sequence of str): modules that register task or method of a file, which cannot import them itself.
        **asked: fields of :class:`~torchrl_koap.modules.Execution`. Others keep their value of the training.

    Returns:
        PlanningPolicy: in evaluation mode, on the device asked for.

    Raises:
        ValueError: for an unknown option or strategy, or a number out of range.
        RunDirectoryError, CheckpointError, PluginError: as :meth:`Trained.load`.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap import Agent, load_policy
        >>> agent = Agent(load_policy("pretrained:avoiding"), seed=0)
        >>> agent.reset()
        >>> agent.act(np.array([0.525, -0.28, 0.525, -0.28])).shape  # commanded and measured xy to a change of xy (m)
        (2,)
    """
    Execution().replaced(**asked)  # an unknown name suggests the nearest
    trained = where if isinstance(where, Trained) else Trained.load(where, plugins=plugins)
    return trained_policy(trained, ExecutionConfig(**asked)).to(device)


def trained_policy(trained: Trained, asked: ExecutionConfig) -> PlanningPolicy:
    """Makes a policy from a finished training; options that are None are those of the training."""
    execution, follower = trained.execution, None
    if asked.strategy == "oracle" and trained.method.plans:
        execution = execution.replaced(gain=1.0)  # the oracle measures the response itself
        follower = OracleFollower(trained.task, blend=asked.on(execution).blend)
    return trained.policy(asked.on(execution), follower=follower)
