# This source code is licensed under the MIT license found in the LICENSE file.
"""What the report says about every picture, and what it adds for a task."""

from __future__ import annotations

from torchrl_koap.tasks.registry import find_task

_FILM = (
    "Recorded commands, played again in the simulator: the first success, or the first rollout if there is none. Long"
    " ones pass faster than they did."
)
CAPTIONS = {
    "rollouts.png": (
        "Executed rollouts",
        "Path of the tool centre from above, to scale; a colour per mode, the table counts successes per mode. Failures"
        " are black and end in a cross (collision) or a square (out of time).",
    ),
    "rollouts.gif": (
        "The same rollouts in real time",
        "Every dot is one rollout, the thin grey line ahead of it is its present plan. Plans that swing from picture to"
        " picture mean a planner that cannot make up its mind between modes.",
    ),
    "film.gif": ("One rollout as the camera sees it", _FILM),
    "film.mp4": ("One rollout as the camera sees it", _FILM),
    "modes.png": (
        "Modes of the successful rollouts",
        "One bar per mode. Black ticks: the share of each mode in the demonstrations. Entropy is 1 when all modes are"
        " equally frequent; a handful of rollouts cannot reach 1 even with an even choice, the title says what to"
        " expect.",
    ),
    "plans.png": (
        "Plans against execution",
        "Wide pale band: the executed path. Thin lines: every plan of that episode; dots: where each was made. A plan"
        " that leaves the band at once was not followed (the controller errs); plans that fan out at their ends were"
        " followed, then replaced (the planner revises). Distances are to the nearest point of the path, whatever the"
        " time; what was planned beyond its end does not count. Failures come first.",
    ),
    "latent.png": (
        "What the latent space holds",
        "Left: eigenvalues of the operator. Middle: errors of predicted states, latent actions given; a test of the"
        " models, not a forecast. Right, for analysis only: how much of the true actions a linear probe on labels"
        " outside the budget, and the run's own decoder, explain on held-out demonstrations.",
    ),
    "inspect.png": (
        "Which part fails",
        "Success of the planner's own imagination, of the controller on recorded states, and of both in closed loop;"
        " distances of executed states to plans.",
    ),
    "demonstrations.png": (
        "Demonstrations and labels",
        "Blue: transitions whose action the training may read. Grey: states only.",
    ),
    "actions.png": (
        "Predicted against recorded actions",
        "For analysis only: the recorded actions of unlabelled demonstrations lie outside the label budget and were not"
        " used for training or selection. Points on the diagonal are exact; a slope below 1 means timid actions, an"
        " offset in the error histogram means drift.",
    ),
    "losses.png": (
        "Losses",
        "Pale: logged values; line: running mean, its last value in the corner. Logarithmic. A planner's loss says"
        " little about its rollouts: judge it by the pictures above.",
    ),
    "eigenvalues.png": (
        "Koopman eigenvalues",
        "Left: eigenvalues of the latent operator; outside the unit circle (orange) predictions blow up. Right: their"
        " magnitudes in order, with the time in which such a part of the state fades.",
    ),
}
_WITH_OBJECTS = {
    "rollouts.gif": " Squares are the objects, pale lines their paths; black marks are tools that ran out of time.",
    "plans.png": " Outlines and thin coloured lines are the objects of that episode: starts and paths.",
    "demonstrations.png": " Beside it the objects that were moved.",
}


def caption(name: str, task: str | None = None) -> tuple[str, str]:
    """Heading and text of a picture.

    Args:
        name (str): file name of the picture.
        task (str, optional): the task, about whose scene a sentence may be added.

    Raises:
        KeyError: if there is no such picture.

    Examples:
        >>> from torchrl_koap.reports.captions import caption
        >>> "cylinders" in caption("rollouts.png", "avoiding")[1], "cylinders" in caption("rollouts.png", "sorting")[1]
        (True, False)
    """
    head, text = CAPTIONS[name]
    known = find_task(task)
    if known is None:
        return head, text
    if name == "rollouts.png":
        return head, text + known.scene.caption
    return head, text + (_WITH_OBJECTS.get(name, "") if known.bodies else "")
