# This source code is licensed under the MIT license found in the LICENSE file.
"""A finished training as a policy, also one that follows plans by the simulator's own inverse map."""

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
    """Makes a policy of a run, or of a file of :meth:`Trained.save`: observations in, an action per step out.

    A :class:`~torchrl_koap.modules.PolicyEnv` hands it what it reads; an :class:`~torchrl_koap.modules.Agent` keeps
    that itself.

    Args:
        where (str, Path or Trained): a run directory, ``"pretrained:NAME"``, a file, or what :func:`~torchrl_koap.fit`
            returned.

    Keyword Args:
        device (str): ``"cpu"`` or ``"cuda"``.
        plugins (sequence of str): modules that register task or method of a file, which cannot have them imported.
        **asked: fields of :class:`~torchrl_koap.modules.Execution`. What is not asked for is as it was trained for.

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
    """Makes a policy of a finished training; options that are None are those of the training."""
    execution, follower = trained.execution, None
    if asked.strategy == "oracle" and trained.method.plans:
        execution = execution.replaced(gain=1.0)  # it knows how commands are answered
        follower = OracleFollower(trained.task, blend=asked.on(execution).blend)
    return trained.policy(asked.on(execution), follower=follower)
