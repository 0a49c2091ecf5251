# This source code is licensed under the MIT license found in the LICENSE file.
"""Tables of the page about Scooping."""

from __future__ import annotations

from result_rows import percent, rows_if_measured, table

STARTS = ("left", "near", "right")


def scooping_probe_table() -> str:
    """A row per pooling, a column per embodiment."""
    rows = rows_if_measured("scooping_probe")
    poolings = list(dict.fromkeys((row["pooling"], row["columns"]) for row in rows))
    whose = list(dict.fromkeys(row["embodiment"] for row in rows))
    found = {(row["pooling"], row["embodiment"]): row["error_mm"] for row in rows}
    body = [[f"`{name}`", columns, *(found[name, who] for who in whose)] for name, columns in poolings]
    judged = {row["embodiment"]: f"{row['demonstrations']} + {row['held_out']} demonstrations" for row in rows}
    return table(["pooling", "columns", *(f"{who} (mm), {judged[who]}" for who in whose)], body)


def scooping_table() -> str:
    """A row per cell of the study."""
    body = []
    for row in rows_if_measured("scooping"):
        rim = percent({"successes": row["rims"], "n": row["n"]}, 0)
        starts = " / ".join(f"{100 * float(row[start]):.0f}" for start in STARTS)
        cell = [
            row["labels"],
            row["unlabelled"],
            f"`{row['method']}`",
            row["execution"].replace("_", " "),
            row["n"],
            rim,
            percent(row, 0),
            starts,
        ]
        body.append([*cell, row["action_error_mrad"] or "not measured"])
    head = ["labelled", "unlabelled", "method", "plans", "rollouts", "rim", "success", "left / near / right (%)"]
    return table([*head, "action error (mrad)"], body)


def scooping_parts_table() -> str:
    """A row per part of the policy that was looked at alone."""
    rows = rows_if_measured("scooping_parts")
    titles = {
        "expert": "the scripted robot",
        "replay": "its joint targets, played among pieces that lie otherwise",
        "controller": "targets decoded from recorded frames, played without looking",
        "planner": "plans of plans from the first frame: the imagined spoon is lifted out",
    }
    body = []
    for row in sorted(rows, key=lambda row: list(titles).index(row["part"])):
        method = f"`{row['method']}`" if row["method"] else ""
        body.append([titles[row["part"]], method, row["n"], percent(row, 0)])
    return table(["part", "method", "episodes", "succeed"], body)
