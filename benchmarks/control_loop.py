# This source code is licensed under the MIT license found in the LICENSE file.
"""Late steps of a control loop whose planner takes 100 ms: plans made between two steps, and in a thread.

python benchmarks/control_loop.py --steps 800 --control-hz 30
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch

from torchrl_koap.evaluation.latency import run_control_loop
from torchrl_koap.modules import (
    Agent,
    AsynchronousAgent,
    StatePlanner,
    TemporalUnet,
    make_koopman_inverse_dynamics,
    make_policy,
)


class SlowPlanner(StatePlanner):
    """Takes as long as a large planner does on a small computer."""

    seconds = 0.1

    def sample(self, *arguments, **options):
        """Plans, and waits for the rest of the time."""
        began = time.perf_counter()
        plan = super().sample(*arguments, **options)
        time.sleep(max(self.seconds - (time.perf_counter() - began), 0))
        return plan


def main() -> None:
    """Prints both loops."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--control-hz", type=float, default=30.0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    planner = SlowPlanner(TemporalUnet(7, 14, channels=(16, 32)), state_dim=7, num_steps=4)
    policy = make_policy(planner, make_koopman_inverse_dynamics(7, 7), state_of=range(7))
    observations = np.random.default_rng(0).normal(size=(options.steps, 7)).cumsum(0) / 100
    print("between steps", run_control_loop(Agent(policy), observations, control_hz=options.control_hz))
    with AsynchronousAgent(policy, control_hz=options.control_hz) as agent:
        print("in a thread  ", run_control_loop(agent, observations, control_hz=options.control_hz))


if __name__ == "__main__":
    main()
