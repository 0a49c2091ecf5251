# This source code is licensed under the MIT license found in the LICENSE file.
"""How fast windows come out of a replay buffer, compared with plain tensors and TorchRL's SliceSampler.

All paths are measured in turns in one run, so that a busy machine slows all of them alike; trust the ratios.

    python benchmarks/replay_speed.py [--trajectories 1000] [--batch 256] [--window 16] [--device cpu]
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time

import torch
from torchrl.data import ReplayBuffer, SliceSampler, TensorDictReplayBuffer, TensorStorage

from torchrl_koap.data import LabelBudget, flatten_trajectories, load_ted, make_window_buffer, save_ted

ENTRIES = ["observation", "action", "has_action"]


def paths(data, batch, window, folder):
    """The ways to get a batch of windows, by name."""
    tensors = [data[key] for key in ENTRIES]
    valid = (data["episode"][: -window + 1] == data["episode"][window - 1 :]).nonzero().squeeze(-1)
    frames = torch.arange(window, device=data["episode"].device)

    def plain():
        index = valid[torch.randint(len(valid), (batch,), device=valid.device)].unsqueeze(-1) + frames
        return [tensor[index] for tensor in tensors]

    def slices(buffer_class, **options):
        sampler = SliceSampler(slice_len=window, traj_key="episode", **options)
        storage = TensorStorage(data.select(*ENTRIES, "episode", ("next", "done"), ("next", "truncated")))
        return buffer_class(storage=storage, sampler=sampler, batch_size=batch * window).sample

    def ours(select=ENTRIES, **options):
        return make_window_buffer(data, window, batch, select=select, **options).sample

    found = {
        "plain tensors, [B, T] index": plain,
        "window buffer": ours(),
        "window buffer, all entries": ours(select=None),
        "window buffer, 25 % labelled": ours(labelled_share=0.25),
        "window buffer, epochs": ours(replacement=False),
        "window buffer, padded": ours(pad_before=1),
        "SliceSampler, cached": slices(TensorDictReplayBuffer, cache_values=True),
        "SliceSampler, cached, plain buffer": slices(ReplayBuffer, cache_values=True),
        "SliceSampler": slices(TensorDictReplayBuffer),
    }
    if data["episode"].device.type == "cpu":
        memmap = load_ted(save_ted(data, folder))
        found["window buffer, memory-mapped"] = make_window_buffer(memmap, window, batch, select=ENTRIES).sample
    return found


def main():
    """Measures and writes a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trajectories", type=int, default=1000)
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--window", type=int, default=16)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--calls", type=int, default=40)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()

    torch.manual_seed(0)
    torch.set_num_threads(1)
    lengths = torch.randint(150, 250, (options.trajectories,)).tolist()
    data = flatten_trajectories([torch.randn(n + 1, 20) for n in lengths], [torch.randn(n, 8) for n in lengths])
    data = LabelBudget(0.02).apply(data)[0].to(options.device)
    synchronize = torch.cuda.synchronize if data["episode"].is_cuda else lambda: None
    with tempfile.TemporaryDirectory() as folder:
        ways = paths(data, options.batch, options.window, f"{folder}/demos")
        times = {name: [] for name in ways}
        for way in ways.values():
            way()
        for _ in range(options.rounds):
            for name, way in ways.items():
                synchronize()
                begin = time.perf_counter()
                for _ in range(options.calls):
                    way()
                synchronize()
                times[name].append((time.perf_counter() - begin) / options.calls)
    medians = {name: statistics.median(values) for name, values in times.items()}
    reference = medians["plain tensors, [B, T] index"]
    rows = [f"{'path':38s} {'ms/batch':>9s} {'windows/s':>10s} {'x plain':>8s}"]
    for name, value in medians.items():
        rows.append(f"{name:38s} {value * 1e3:9.3f} {options.batch / value:10.0f} {value / reference:8.2f}")
    sys.stdout.write("\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
