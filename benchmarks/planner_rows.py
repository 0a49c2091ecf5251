# This source code is licensed under the MIT license found in the LICENSE file.
"""The planners that were tried as rows of docs/results/planners.md; the picture of success against demonstrations."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
from result_rows import percent, read_rows, success, table

from torchrl_koap.evaluation.statistics import wilson_interval

PLANNERS = {  # those that most rows have, and their options; the first one that fits gives the name
    "U-Net": "unet channels=(32, 64) recovery_sigma=0.004 planner_learning_rate=0.003",
    "wide MLP": "mlp denoiser_width=512 denoiser_depth=4 condition_octaves=1 precision=bfloat16 recovery_sigma=0.004"
    " planner_learning_rate=0.001",
    "wide MLP of 4 octaves": "mlp denoiser_width=512 denoiser_depth=4 precision=bfloat16 recovery_sigma=0.004"
    " planner_learning_rate=0.001",
}
LEAST = 180  # rollouts of a row that others are compared with
SHORT = "8000"  # updates of the trainings that are compared with each other, a third of the default's
# what the short trainings that are compared have in common; all of them are of before commands were held back
_COMPARED = {"updates": SHORT, "controller": "learned", "method": "koap", "candidates": 1, "command_lead": 0.0}
_OPTION = re.compile(r"[^\s(]+\([^)]*\)|\S+")


def planner_words(denoiser: str) -> str:
    """A planner as one of :data:`PLANNERS` and what it has besides, or in full where it is none of them."""
    options = _OPTION.findall(denoiser)
    for name, known in PLANNERS.items():
        common = _OPTION.findall(known)
        if set(common) <= set(options):
            return ", ".join([name, *(f"`{option}`" for option in options if option not in common)])
    return f"`{denoiser}`"


def boxes(row: Mapping[str, str]) -> str:
    """How often the first box of Stacking reached its zone, and two did, empty for other tasks."""
    if not row.get("stacked"):
        return ""
    first, two, _ = (100 * int(count) / int(row["n"]) for count in row["stacked"].split())
    return f"first box {first:.1f} %, two {two:.1f} %"


def pooled_boxes(rows: Sequence[Mapping[str, str]]) -> str:
    """How many boxes of Stacking several rows together brought to the zone, with Wilson intervals."""
    n = sum(int(row["n"]) for row in rows)
    counts = [sum(int(row["stacked"].split()[place]) for row in rows) for place in range(3)]
    first, two, three = (percent({"successes": str(count), "n": str(n)}) for count in counts)
    return f"the first box in {first} of {n} rollouts, two in {two}, all three in {three}"


def leashed(row: Mapping[str, str]) -> str:
    """How far ahead of the robot its command may be, empty where it may run away."""
    lead = float(row["command_lead"])
    return f"command at most {lead:g} ahead" if lead else ""


def paced(row: Mapping[str, str]) -> str:
    """What the actions were multiplied by, empty where by nothing."""
    return "" if float(row["action_gain"]) == 1 else f"actions times {float(row['action_gain']):g}"


def method_words(row: Mapping[str, str]) -> str:
    """The method, and its preset where that is not the default's."""
    return f"`{row['method']}`" + (f", `{row['preset']}`" if row["preset"] == "semi_supervised" else "")


def planner_table(rows: Sequence[Mapping[str, str]]) -> str:
    """A row per trained planner and way to run it."""
    head = [
        "labels",
        "method",
        "planner",
        "demonstrations",
        "updates x batch",
        "seed",
        "candidates",
        "success in % (95 %), entropy",
        "steps",
        "",
    ]
    body = [
        [
            row["labels"],
            "*oracle*" if row["controller"] == "oracle" else method_words(row),
            planner_words(row["denoiser"]),
            row["demonstrations"] + (" disturbed" if disturbed(row) else ""),
            f"{row['updates']} x {row['batch']}",
            row["training_seed"],
            row["candidates"] if row["candidates"] == "1" else f"{row['candidates']}, {row['choice']}",
            success(row),
            row["mean_steps"],
            "; ".join(filter(None, [row["note"], boxes(row), leashed(row), paced(row)])),
        ]
        for row in rows
    ]
    return table(head, body)


def planner_options() -> str:
    """The definitions of the short names in the tables."""
    return "\n".join(f"* *{name}*: `{options}`" for name, options in PLANNERS.items())


def disturbed(row: Mapping[str, str]) -> bool:
    """Whether operators were disturbed while the demonstrations were recorded."""
    return float(row["disturbed"] or 0) > 0


def amounts(task: str = "aligning") -> list[dict[str, str]]:
    """Short trainings of a task that differ in the demonstrations alone, by their number."""
    rows = read_rows("planner_ablations", task=task, **_COMPARED)
    rows = [row for row in rows if planner_words(row["denoiser"]) == "wide MLP" and row["labels"] != "all"]
    return sorted(rows, key=lambda row: (disturbed(row), int(row["demonstrations"]), row["training_seed"]))


def planner_variants() -> list[dict[str, str]]:
    """Short trainings on all demonstrations of Aligning that differ in the planner's options, the plain one first."""
    rows = read_rows("planner_ablations", task="aligning", demonstrations=1000, **_COMPARED)
    rows = [row for row in rows if row["labels"] != "all"]
    return sorted(rows, key=lambda row: (row["denoiser"] not in PLANNERS.values(), int(row["successes"])))


def disturbances() -> list[dict[str, str]]:
    """Short trainings of Aligning with one observed frame, by what was disturbed while its operators played."""
    common = {"updates": SHORT, "demonstrations": 1000, "controller": "learned", "candidates": 1}
    rows = read_rows("planner_ablations", task="aligning", **common)
    rows = [row for row in rows if row["denoiser"] == PLANNERS["wide MLP"] + " observed_frames=1"]
    return sorted(rows, key=lambda row: (disturbed(row), not row["note"], row["labels"], row["training_seed"]))


def gains(rows: Sequence[Mapping[str, str]]) -> str:
    """Successes of one trained run by the gain of its actions."""
    rows = sorted({float(row["action_gain"]): row for row in rows}.items())
    return ", ".join(f"`{gain:g}`: {row['successes']} of {row['n']}" for gain, row in rows)


def decoded_sizes(task: str) -> str:
    """Decoded size of actions over the recorded one, over the trained runs."""
    shares = sorted({row["share"] for row in read_rows("decoded_sizes", task=task)})
    return f"`{shares[0]}`" if len(shares) == 1 else f"`{shares[0]}` to `{shares[-1]}`"


def directions_table() -> str:
    """Decoded share of a planned motion by direction, a row per trained run."""
    runs: dict[tuple[str, str], dict[str, str]] = defaultdict(dict)
    for row in read_rows("decoded_directions"):
        share = f"{float(row['share']):.2f} ({float(row['low']):.2f} to {float(row['high']):.2f})"
        runs[row["run"], row["disturbed"]][row["planned"]] = share
    directions = list(next(iter(runs.values())))
    body = [[how, *(cells[direction] for direction in directions)] for (_, how), cells in runs.items()]
    return table(["operators disturbed", *(f"`{direction}`" for direction in directions)], body)


def same_planner_table() -> str:
    """Tasks with a planner that the simulator's inverse map followed: the same planner with learned controllers."""
    rows = [row for row in read_rows("planner_ablations") if row["candidates"] == "1" and int(row["n"]) >= LEAST]
    other = ("ran away", "left alone")  # of a planner of its own, which the columns do not tell
    rows = [row for row in rows if not any(words in row["note"] for words in other)]
    same = (
        "task",
        "denoiser",
        "updates",
        "batch",
        "demonstrations",
        "disturbed",
        "training_seed",
        "command_lead",
        "action_gain",
    )
    body = []
    for oracle in (row for row in rows if row["controller"] == "oracle"):
        beside = [row for row in rows if all(row[name] == oracle[name] for name in same)]
        for row in sorted(beside, key=lambda row: (row["controller"] == "oracle", row["method"], row["labels"])):
            told = "*oracle*" if row["controller"] == "oracle" else f"`{row['method']}`, {row['labels']}"
            planner = f"{planner_words(row['denoiser'])}, {row['updates']}"
            cells = [row["task"], planner, told, success(row), row["note"] or boxes(row)]
            if row["blend_decay"] == oracle["blend_decay"] and cells not in body:
                body.append(cells)
    return table(["task", "planner, updates", "controller, labels", "success in % (95 %), entropy", ""], body)


def stuck_table() -> str:
    """How episodes ran out of time, by task and by what was done against it."""
    groups = defaultdict(list)
    for row in read_rows("stuck_episodes"):
        groups[row["task"], float(row["command_lead"]), float(row["gripper_recovery"])].append(row)
    counted = ("n", "out_of_time", "runaway", "fingers", "one place", "moving")
    body = []
    for (task, lead, share), rows in sorted(groups.items()):
        kept = [f"command at most {lead:g} ahead" if lead else "", f"`--gripper-recovery {share:g}`" if share else ""]
        sums = [str(sum(int(row[name]) for row in rows)) for name in counted]
        body.append([f"`{task}`", ", ".join(filter(None, kept)) or "nothing", str(len(rows)), *sums])
    head = ["task", "done against it", "evaluations", "rollouts", "out of time", "command ran away"]
    return table([*head, "fingers closed on nothing", "in one place", "still moving"], body)


def draw_amounts(path: Path) -> Path:
    """Draws success against demonstrations, with undisturbed and with disturbed operators.

    Args:
        path (Path): the picture.

    Returns:
        Path: the same.
    """
    figure, axis = plt.subplots(figsize=(4.6, 3.2))
    series = defaultdict(list)
    for row in amounts():
        series[disturbed(row)].append((int(row["demonstrations"]), int(row["successes"]), int(row["n"])))
    looks = {False: ("#0b6e4f", "o", "operators undisturbed"), True: ("#c1440e", "D", "half of them disturbed")}
    for kind, points in series.items():
        color, marker, label = looks[kind]
        numbers, rates = [n for n, _, _ in points], [100 * won / of for _, won, of in points]
        low, high = zip(*(wilson_interval(won, of) for _, won, of in points), strict=True)
        below = [rate - 100 * end for rate, end in zip(rates, low, strict=True)]
        above = [100 * end - rate for rate, end in zip(rates, high, strict=True)]
        places = [number * (1.07 if kind else 1.0) for number in numbers]  # beside each other
        axis.errorbar(places, rates, [below, above], color=color, marker=marker, ms=5, capsize=3, label=label)
    axis.set_xscale("log")
    ticks = sorted({number for points in series.values() for number, _, _ in points})
    axis.set_xticks(ticks, [str(tick) for tick in ticks])
    axis.minorticks_off()
    axis.set_ylim(0, 100)
    axis.set_xlabel("demonstrations")
    axis.set_ylabel("success (%)")
    axis.legend(frameon=False, loc="lower right")
    axis.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(path, dpi=130, metadata={"Software": None})
    plt.close(figure)
    return path
