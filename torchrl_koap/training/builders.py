# This source code is licensed under the MIT license found in the LICENSE file.
"""Builds controllers from the plain options that a run directory keeps in ``config.json``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict import TensorDictBase
from torch import nn

from torchrl_koap.lookup import lookup
from torchrl_koap.modules import PRESETS, Normalizer
from torchrl_koap.training.method import Method, normalizers_of
from torchrl_koap.training.methods import get_method


def build_controller(
    options: Mapping[str, Any],
    state_dim: int,
    action_dim: int,
    labelled: TensorDictBase | None = None,
    *,
    method: Method | None = None,
) -> nn.Module:
    """A controller, with statistics of the data if these are given, else without (weights bring them).

    Args:
        options (mapping): the ``controller`` entry of ``config.json``: method, decoder and preset.
        state_dim (int): number of state columns.
        action_dim (int): number of action columns.
        labelled (TensorDictBase, optional): flat data after the label budget was applied. State statistics come from
            all of it (of the labelled steps for a method that sees no others), action statistics from the labelled
            steps alone.

    Keyword Args:
        method (Method, optional): the method, where it was looked up already. Default: the one that ``options`` name.

    Raises:
        ValueError: for an unknown method, decoder or preset.
    """
    method = method_named(options) if method is None else method
    modes = lookup(PRESETS, options["preset"], "preset")["normalization"]
    if labelled is None:
        normalizers = normalizers_of(Normalizer(state_dim), Normalizer(action_dim))
    else:
        seen = labelled["has_action"] if method.labelled_only else None
        normalizers = normalizers_of(
            Normalizer.fit(labelled["state"], mode=modes["state"], mask=seen),
            Normalizer.fit(labelled["action"], mode=modes["action"], mask=labelled["has_action"]),
        )
    return method.build(state_dim, action_dim, normalizers, options)


def method_named(options: Mapping[str, Any]) -> Method:
    """The method that the ``controller`` entry of ``config.json`` names.

    Raises:
        ValueError: if there is none.
    """
    return get_method(options["method"], options.get("decoder"))
