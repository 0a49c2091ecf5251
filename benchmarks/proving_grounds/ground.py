# This source code is licensed under the MIT license found in the LICENSE file.
"""Defines proving grounds: external demonstrations as a data set, a simulator, and how policies are scored."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

SHARED = Path(os.environ.get("KOAP_SHARED", Path(__file__).resolve().parents[3] / "shared")) / "proving_grounds"


@dataclass(frozen=True)
class Ground:
    """External demonstrations and how policies trained on them are scored.

    Args:
        write (callable): writes all demonstrations with their actions into a folder, as a data set of ``koap train``.
        score (str): ``"reward"``, the largest of a rollout, or ``"success"``, both in a simulator; or ``"errors"`` of
            plans and actions on recordings.
        labels (tuple of int): default numbers of labelled demonstrations.
        n (int): rollouts per cell; for ``"errors"`` the number of recordings; action errors use the unlabelled ones.
        env (str, optional): id of the simulator, which the module of the ground registers.
        max_steps (int): control steps of a rollout.
        data (Path, optional): file or folder that must exist.
        package (str, optional): module of the simulator.
        install (str): command that installs that package.
        runs_of (str, optional): ground whose data set and runs this one scores. Default: its own.
    """

    write: Callable[[Path], None]
    score: Literal["reward", "success", "errors"]
    labels: tuple[int, ...]
    n: int
    env: str | None = None
    max_steps: int = 0
    data: Path | None = None
    package: str | None = None
    install: str = ""
    runs_of: str | None = None

    def missing(self) -> str | None:
        """Returns what is missing to run this ground and how to get it; None if nothing is missing."""
        if self.data is not None and not self.data.exists():
            return (
                f"{self.data} is not there: set KOAP_SHARED to the folder that holds proving_grounds/{self.data.name}"
            )
        if self.package is not None:
            try:
                importlib.import_module(self.package)
            except ImportError as error:  # of the package, or of one that it needs
                return f"{error}: {self.install}"
        return None
