# This source code is licensed under the MIT license found in the LICENSE file.
"""LeRobot data sets of every version, written from demonstrations."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from torchrl_koap.data import flatten_trajectories
from torchrl_koap.tasks import get_task

pytest.importorskip("pyarrow", reason="pyarrow is not installed (extra lerobot)")
import pyarrow as pa  # noqa: E402
import pyarrow.parquet as pq  # noqa: E402
from safetensors.numpy import save_file  # noqa: E402

VERSIONS = ("v1.6", "v2.1", "v3.0")


def episodes_of(data):
    """Frames ``[T, obs]`` and actions ``[T, act]`` of every episode; nothing was recorded after the last frame."""
    pairs = []
    for number in data["episode"].unique():
        part = data[data["episode"] == number]
        frames = torch.cat([part["observation"], part["next", "observation"][-1:]])
        pairs.append((frames, torch.cat([part["action"], torch.zeros_like(part["action"][:1])])))
    return pairs


def made_up(task, lengths=(5, 8), seed=0):
    """Random observations of a task whose command follows from the actions."""
    generator = torch.Generator().manual_seed(seed)
    facts = get_task(task)
    size, frames_of, steps_of = len(facts.delta_actions), [], []
    command = facts.observation[facts.command] if facts.command else slice(0, facts.action_dim)
    for length in lengths:
        frames = torch.randn(length, facts.observation_dim, generator=generator, dtype=torch.float64)
        changes = frames[:, command].diff(dim=0)
        changes[:, size:] = frames[1:, command][:, size:]
        frames_of.append(frames)
        steps_of.append(changes)
    return flatten_trajectories(frames_of, steps_of)


def table(numbers, pairs, features=None, fixed=False):
    kind = pa.list_(pa.float32(), pairs[0][1].shape[1]) if fixed else pa.list_(pa.float32())
    columns = {
        "observation.state": pa.array([row for frames, _ in pairs for row in frames.tolist()], pa.list_(pa.float32())),
        "action": pa.array([row for _, steps in pairs for row in steps.tolist()], kind),
        "episode_index": pa.array(np.repeat(numbers, [len(frames) for frames, _ in pairs])),
        "frame_index": pa.array(np.concatenate([np.arange(len(frames)) for frames, _ in pairs])),
        "timestamp": pa.array(np.concatenate([np.arange(len(frames)) / 28.57 for frames, _ in pairs])),
        "next.done": pa.array([False] * sum(len(frames) for frames, _ in pairs)),
    }
    return pa.table(columns | (features or {}))


def write(file, content):
    file.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(content, file)


def write_lerobot(root, data, version="v2.1", *, names=None, splits=None, fps=1 / 0.035, change=None):
    """Writes a LeRobot data set; ``change`` is called with each table before it is written."""
    pairs, change = episodes_of(data), change or (lambda content: content)
    lengths = [len(frames) for frames, _ in pairs]
    info = {"codebase_version": version, "fps": fps}
    if version == "v1.6":
        write(root / "data/train-00000-of-00001.parquet", change(table(range(len(pairs)), pairs)))
        (root / "meta_data").mkdir()
        (root / "meta_data/info.json").write_text(json.dumps(info))
        ends = np.cumsum(lengths)
        save_file({"from": ends - lengths, "to": ends}, root / "meta_data/episode_data_index.safetensors")
        return root
    info |= {
        "total_episodes": len(pairs),
        "total_frames": sum(lengths),
        "splits": splits or {"train": f"0:{len(pairs)}"},
        "features": {"observation.state": {"dtype": "float32", "names": names}, "action": {"dtype": "float32"}},
    }
    listed = [{"episode_index": number, "tasks": ["avoid"], "length": size} for number, size in enumerate(lengths)]
    if version == "v2.1":
        for number, pair in enumerate(pairs):
            write(root / f"data/chunk-000/episode_{number:06d}.parquet", change(table([number], [pair], fixed=True)))
        (root / "meta").mkdir()
        (root / "meta/episodes.jsonl").write_text("".join(json.dumps(entry) + "\n" for entry in listed))
    else:
        write(root / "data/chunk-000/file-000.parquet", change(table(range(len(pairs) - 1), pairs[:-1])))
        write(root / "data/chunk-000/file-001.parquet", change(table([len(pairs) - 1], pairs[-1:])))
        write(root / "meta/episodes/chunk-000/file-000.parquet", pa.Table.from_pylist(listed))
    (root / "meta/info.json").write_text(json.dumps(info))
    return root


def with_column(name, edit):
    """A change of one column, given as a list of its rows."""

    def change(content):
        rows = content[name].to_pylist()
        position = content.column_names.index(name)
        return content.set_column(position, name, pa.array(edit(rows)))

    return change
