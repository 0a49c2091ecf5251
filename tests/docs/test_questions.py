# This source code is licensed under the MIT license found in the LICENSE file.
"""What a newcomer asks is answered on a page that a search for its words finds."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
# question: page, words that somebody searches for
QUESTIONS = {
    "How many demonstrations, and how many with actions?": (
        "howto/prepare_data",
        "how many recordings actions 50 label 5",
    ),
    "Which method for my data?": ("howto/choose_method", "choose method noisy clean recorded command joints"),
    "Are my actions delta or absolute?": ("howto/prepare_data", "delta absolute targets LeRobot --action-kind"),
    "What are robot, command and targets?": ("howto/prepare_data", "robot command targets leader follower"),
    "How long does training take, on what, and is a GPU faster?": (
        "howto/train_faster",
        "faster GPU cuda minutes loss memory",
    ),
    "What loss is good?": ("howto/train_faster", "loss good relative_plan_error"),
    "Can I use my cameras?": ("howto/cameras", "camera frames embed pictures run time"),
    "Gripper: binary or continuous?": ("howto/prepare_data", "gripper width 0 or 1 absolute"),
    "Which rates?": ("howto/prepare_data", "rate Hz window 16 frames resample irregular"),
    "Missing frames, NaN, short recordings, pauses?": ("howto/prepare_data", "missing NaN shorter pauses length"),
    "Two arms, mobile base, several tasks, language?": (
        "howto/prepare_data",
        "two arms mobile base hand several tasks language",
    ),
    "Quaternions, angles, units, normalisation?": ("howto/prepare_data", "quaternions angles wrap normalise units"),
    "Must goals be in the state? May labelled ones differ?": (
        "howto/prepare_data",
        "goals objects state speed operator another robot",
    ),
    "What is limited before a command reaches the arm?": ("howto/control_loop", "limits stop safety speed driver"),
    "Delay, jerk?": ("howto/control_loop", "delay sensor actuator slow plans"),
    "Jerk between plans?": ("howto/find_failures", "jerk plans oscillation"),
    "It fails: what first?": ("howto/find_failures", "symptom cause remedy fails first"),
    "When is an action error good?": ("howto/no_simulator", "action error good ridge mean action"),
    "Add data later, fine-tune, use a pretrained policy?": ("limits", "fine-tuning more data pretrained another robot"),
    "ROS 2?": ("howto/control_loop", "ROS 2"),
    "Docker, Jetson, Windows, macOS, PyPI?": ("reference/versions", "Docker Jetson Windows macOS PyPI"),
    "Where is it hosted, whom do I ask?": ("limits", "hosted issues help"),
    "Who made this, how to cite, which licence?": ("limits", "cite licence MIT D3IL pretrained"),
    "Relation to the authors of KOAP?": ("index", "independent authors Bi et al."),
    "Which TorchRL versions?": ("reference/versions", "TorchRL torchrl>= minor versions"),
    "What is reused from TorchRL, what is not?": (
        "howto/torchrl",
        "reuse SliceSampler DiffusionActor DiffusionBCLoss LeRobotExperienceReplay MinariExperienceReplay CEMPlanner"
        " MPCPlannerBase VecNormV2 Trainer",
    ),
    "check_env_specs, partial resets, ParallelEnv, devices?": (
        "howto/torchrl",
        "check_env_specs reset in parts ParallelEnv CPU",
    ),
    "torch.compile, vmap, CUDA graphs, set_keys?": (
        "howto/torchrl",
        "torch.compile vmap CUDA graphs nested keys set_keys",
    ),
    "Fine-tuning by RL?": ("howto/torchrl", "log-probability fine-tuning set_exploration_type noise transform"),
    "API stability?": ("howto/torchrl", "stability public changelog 1.0"),
}


def text_of(page: str) -> str:
    return " ".join((DOCS / f"{page}.md").read_text().lower().split())


@pytest.mark.parametrize("question", QUESTIONS)
def test_a_question_is_answered_on_a_page_that_its_words_find(question):
    page, words = QUESTIONS[question]
    missing = [word for word in words.split() if word.lower() not in text_of(page)]
    assert not missing, f"{page}.md does not hold {missing}"


def test_every_page_is_in_the_navigation():
    """By the tables of contents, or in a folder that is outside of it."""
    listed = set()
    for page in DOCS.rglob("*.md"):
        for body in re.findall(r"```\{toctree\}\n(.*?)```", page.read_text(), re.DOTALL):
            lines = [line.strip() for line in body.splitlines() if line.strip() and not line.startswith(":")]
            listed |= {(page.parent / line).resolve().relative_to(DOCS) for line in lines}
    pages = {page.relative_to(DOCS).with_suffix("") for page in DOCS.rglob("*.md")}
    outside = {page for page in pages if page.parts[0] in ("appendix", "generated")}
    assert pages - outside - listed == {Path("index")}
