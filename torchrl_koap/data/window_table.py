# This source code is licensed under the MIT license found in the LICENSE file.
"""Where windows may start: every start that leaves the window inside one trajectory, tabulated once.

With ``pad_before`` and ``pad_after`` windows may reach over the ends of their trajectory by that many frames, whose
place is taken by the first or last step::

    steps of the trajectory                0 1 2 3 4
    window 3, no padding                   0 1 2 ... 2 3 4
    window 3, pad_before 1, pad_after 1    0 0 1 ... 3 4 4
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDictBase

from torchrl_koap import keys


@dataclass(frozen=True)
class WindowTable:
    """All windows of a data set.

    Args:
        starts (Tensor): int64 ``[M]``, storage index of frame 0; outside the trajectory where frames are padded.
        first (Tensor): int64 ``[M]``, index of the first step of the window's trajectory.
        last (Tensor): int64 ``[M]``, index of its last step.
        labelled (Tensor): bool ``[M]``, whether an inner frame, ``history - 1 .. window - 2``, has an action label and
            neither that frame nor the one after it is padded.
        num_steps (int): number of steps of the data set.

    Examples:
        >>> import torch
        >>> from torchrl_koap.data import WindowTable, flatten_trajectories
        >>> table = WindowTable.build(flatten_trajectories([torch.rand(6, 2)] * 2, [torch.rand(5, 1)] * 2), 4)
        >>> table.starts.tolist(), table.last.tolist(), table.num_steps
        ([0, 1, 5, 6], [4, 4, 9, 9], 10)
    """

    starts: torch.Tensor
    first: torch.Tensor
    last: torch.Tensor
    labelled: torch.Tensor
    num_steps: int

    @classmethod
    def build(
        cls,
        data: TensorDictBase,
        window: int,
        *,
        history: int = 2,
        pad_before: int = 0,
        pad_after: int = 0,
        short: Literal["error", "drop"] = "error",
    ) -> WindowTable:
        """Tabulates the windows of flat data.

        Args:
            data (TensorDictBase): flat data ``[N]`` with ``episode``; ``step_count`` and ``has_action`` are used if
                they are there.
            window (int): frames per window.
            history (int): frames up to and including "now".
            pad_before (int): frames by which a window may begin before its trajectory (the first frame is repeated).
            pad_after (int): frames by which a window may end after its trajectory (the last frame is repeated).
            short (str): what to do with trajectories too short for one window: ``"error"``, or ``"drop"`` them with a
                warning.

        Raises:
            KeyError: if there is no ``episode``.
            ValueError: if an argument is out of range, or a trajectory is too short.

        Examples:
            >>> import torch
            >>> from tensordict import TensorDict
            >>> from torchrl_koap.data import WindowTable
            >>> WindowTable.build(TensorDict({"episode": torch.tensor([0, 0, 0, 0, 1, 1, 1])}, [7]), 3).starts
            tensor([0, 1, 4])
        """
        check_window(window, history, pad_before, pad_after, short)
        episode = data.get(keys.EPISODE, None)
        if episode is None:
            raise KeyError(f"windows need the entry {keys.EPISODE!r}; the data have {sorted(map(str, data.keys()))}")
        device, steps = episode.device, len(episode)
        new = torch.ones(steps, dtype=torch.bool, device=device)
        new[1:] = episode[1:] != episode[:-1]
        count = data.get(keys.STEP_COUNT, None)
        if count is not None:  # in a ring that was written over, steps of one trajectory need not be consecutive
            new[1:] |= count[1:] != count[:-1] + 1
        first = new.nonzero().squeeze(-1)
        lengths = torch.diff(first, append=torch.tensor([steps], device=device))
        windows = (lengths + pad_before + pad_after - window + 1).clamp_min(0)
        _check_lengths(episode[first], lengths, windows, window - pad_before - pad_after, short)

        trajectory = torch.arange(len(first), device=device).repeat_interleave(windows)
        number = torch.arange(len(trajectory), device=device) - (windows.cumsum(0) - windows)[trajectory]
        starts = first[trajectory] - pad_before + number
        first, last = first[trajectory], (first + lengths - 1)[trajectory]
        labelled = torch.zeros_like(starts, dtype=torch.bool)
        has_action = data.get(keys.HAS_ACTION, None)
        if has_action is not None:
            before = torch.zeros(steps + 1, dtype=torch.int64, device=device)
            before[1:] = has_action.reshape(-1).cumsum(0)
            low = torch.maximum(starts + history - 1, first)
            high = torch.minimum(starts + window - 2, last - 1)
            labelled = before[(high + 1).clamp_min(0)] > before[low.clamp_max(steps)]
        return cls(starts=starts, first=first, last=last, labelled=labelled, num_steps=steps)


def check_window(window: int, history: int, pad_before: int, pad_after: int, short: str) -> None:
    """Checks the options that describe a window.

    Args:
        window (int): frames per window.
        history (int): frames up to and including "now", ``1 .. window - 1``.
        pad_before (int): frames by which a window may begin before its trajectory, ``0 .. window - 1``.
        pad_after (int): frames by which it may end after its trajectory, ``0 .. window - 1``.
        short (str): ``"error"`` or ``"drop"``.

    Raises:
        ValueError: if one is out of range.
    """
    if not 1 <= history < window:
        raise ValueError(f"wanted 1 <= history < window, got history {history} and window {window}")
    for name, value in (("pad_before", pad_before), ("pad_after", pad_after)):
        if not 0 <= value < window:
            raise ValueError(f"{name} must be in 0..{window - 1} frames (less than the window), got {value}")
    if short not in ("error", "drop"):
        raise ValueError(f"short must be 'error' or 'drop', got {short!r}")


def _check_lengths(
    episodes: torch.Tensor, lengths: torch.Tensor, windows: torch.Tensor, least: int, short: str
) -> None:
    dropped = windows == 0
    if not dropped.any():
        return
    listed = ", ".join(
        f"{episode} ({length} steps)"
        for episode, length in zip(episodes[dropped].tolist()[:10], lengths[dropped].tolist()[:10], strict=True)
    )
    number, total = int(dropped.sum()), len(lengths)
    message = f"{number} of {total} trajectories are shorter than a window ({least} steps): {listed}"
    if number > 10:
        message += ", ..."
    if short == "error" or number == total:
        raise ValueError(message)
    warnings.warn(message + "; they are left out", stacklevel=4)
