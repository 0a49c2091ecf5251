# This source code is licensed under the MIT license found in the LICENSE file.
"""Which environment and which numbering of modes belong to a task name. Another task is a line in each table."""

from __future__ import annotations

from functools import partial

from torchrl_koap.envs import aligning, avoiding, sorting, stacking

ENVIRONMENTS = {
    "avoiding": avoiding.AvoidingEnv,
    "aligning": aligning.AligningEnv,
    "sorting": partial(sorting.SortingEnv, num_boxes=4),
    "sorting_2": partial(sorting.SortingEnv, num_boxes=2),
    "sorting_6": partial(sorting.SortingEnv, num_boxes=6),
    "po_sorting": partial(sorting.SortingEnv, num_boxes=4),
    "stacking": partial(stacking.StackingEnv, num_boxes=3),
    "stacking_1": partial(stacking.StackingEnv, num_boxes=1),
}


def _first_box(mode):
    """Mode of a task that is over with the first box: that box."""
    return mode[..., 0].long()


MODE_INDEX = {
    "avoiding": avoiding.mode_index,
    "aligning": aligning.mode_index,
    "sorting": sorting.mode_index,
    "sorting_2": sorting.mode_index,
    "sorting_6": sorting.mode_index,
    "po_sorting": sorting.mode_index,
    "stacking": stacking.mode_index,
    "stacking_1": _first_box,
}
