# This source code is licensed under the MIT license found in the LICENSE file.
"""What is missing where the arm's joints are not seen: rollouts with parts of the controller replaced, one by one.

    python benchmarks/hidden_posture.py runs/stacking --dataset DEMOS

    gripper   "decoded": its number comes from the controller; "planned": read off the planned widths
    motion    "decoded": changes of the joint commands come from the controller; "posture": differences of the posture
              that a network gives for planned and present state
    pull      share of the distance between the posture for the present state and the command in force that is added to
              the command at every step; 0: nothing keeps the joints where demonstrations had them

The network is fitted to the joint commands of ALL steps of all demonstrations: far more than any label budget, so this
is no method, but says what knowing the posture would be worth. Rows are appended to the table; a variant that is there
already is left out.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from resumable_table import open_table
from torch import Tensor

from torchrl_koap.evaluation import EvalConfig
from torchrl_koap.evaluation.diagnosis import executed_success
from torchrl_koap.evaluation.rollouts import roll_out
from torchrl_koap.evaluation.run import place_of
from torchrl_koap.evaluation.statistics import wilson_interval
from torchrl_koap.evaluation.trained_run import load_policy, load_run
from torchrl_koap.modules import CommandPosture, PlanThenControl, PostureTracking
from torchrl_koap.tasks.action_rules import ActionRule
from torchrl_koap.training.datasets import load_demonstrations
from torchrl_koap.training.posture import build_posture, fit_posture, posture_columns

TABLE = Path(__file__).parent / "results" / "hidden_posture.csv"
COLUMNS = ("task", "run", "gripper", "motion", "pull", "seed", "n", "successes", "low", "high")
# gripper, motion, pull
VARIANTS = (
    ("decoded", "decoded", 0.0),
    ("planned", "decoded", 0.0),
    ("planned", "decoded", 0.3),
    ("planned", "posture", 0.0),
    ("planned", "posture", 0.3),
)


class Replaced(PostureTracking):
    """A policy of which some parts are the controller's (:func:`replace_parts`)."""

    def _replaced(self, observed: Tensor, history: Tensor, plan: Tensor, action: Tensor) -> Tensor:
        changed = super()._replaced(observed, history, plan, action)
        if self.parts[1] == "decoded":
            joints = self.posture.actions
            now, command = history[..., -1, :], observed[..., -1:, self.posture.commands]
            pulled = self.pull * (self.posture(now).unsqueeze(-2) - command)
            changed[..., joints] = action[..., joints] + pulled.to(action)
        return changed


def replace_parts(policy: PlanThenControl, posture: CommandPosture, variant: tuple[str, str, float]) -> None:
    """Turns a loaded policy into one whose parts are those of a variant."""
    policy.__class__ = Replaced
    policy.posture, policy.parts, policy.pull = posture, variant[:2], variant[2]
    policy.action_rule = ActionRule(posture.gripper) if variant[0] == "planned" else None


def main() -> None:
    """Adds what the table lacks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--dataset", required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[100])
    parser.add_argument("--episodes", type=int, default=60)
    parser.add_argument("--table", type=Path, default=TABLE)
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    done, write = open_table(options.table, COLUMNS, COLUMNS[:6])
    run = load_run(options.run)
    task, posture = run.task, None
    for seed in options.seeds:
        for variant in VARIANTS:
            facts = (task.name, options.run.name, *map(str, variant), str(seed))
            if facts in done:
                continue
            if posture is None:
                posture = build_posture(posture_columns(task))
                fit_posture(posture, load_demonstrations(options.dataset, task))
            config = EvalConfig(episodes=options.episodes, seed=seed)
            place, policy = place_of(task, config), load_policy(run, config)
            replace_parts(policy, posture, variant)
            seeds = list(range(seed, seed + options.episodes))
            episodes = roll_out(policy, place.make_env, seeds, max_steps=place.max_steps, contexts=place.contexts)
            count = sum(executed_success(episodes))
            low, high = wilson_interval(count, len(episodes))
            write((*facts, len(episodes), count, f"{low:.3f}", f"{high:.3f}"))
            print(*facts, count, "of", len(episodes), flush=True)


if __name__ == "__main__":
    main()
