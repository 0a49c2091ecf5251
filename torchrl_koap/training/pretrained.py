# This source code is licensed under the MIT license found in the LICENSE file.
"""Publishing trained policies, and runs that are evaluated in another folder than their own."""

from __future__ import annotations

import shutil
from pathlib import Path

from torchrl_koap.training.checkpoints import load_tensors, save_tensors
from torchrl_koap.training.compact_weights import compact
from torchrl_koap.training.digests import DIGESTS, write_digests
from torchrl_koap.training.run_directory import RunDirectory, RunDirectoryError
from torchrl_koap.training.run_lookup import PREFIX, find_run

# what a run is made of; evaluations, reports and checkpoints are made from it
WEIGHTS = ("planner.safetensors", "controller.safetensors")
PLACES = ("out", "dataset", "planner_from")
FILES = ("config.json", "summary.json", "metrics.csv", "eigenvalues.safetensors", *WEIGHTS, DIGESTS)


def copy_run(source: str | Path, target: str | Path) -> Path:
    """Copies what a run is made of, and nothing that an evaluation wrote, to a folder that is new or holds that run.

    Args:
        source (str or Path): run directory.
        target (str or Path): the other folder.

    Returns:
        Path: the other folder.

    Raises:
        RunDirectoryError: if the source is no run, or the target holds another one.
    """
    source, target = Path(source), Path(target)
    config = RunDirectory(source).read_json("config.json")
    if (target / "config.json").exists() and RunDirectory(target).read_json("config.json") != config:
        raise RunDirectoryError(f"{target} holds another run than {source}; choose another --out")
    target.mkdir(parents=True, exist_ok=True)
    for name in FILES:
        if (source / name).exists():
            shutil.copyfile(source / name, target / name)
    return target


def writable_folder(run: str | Path, out: str | Path | None = None) -> Path:
    """The folder that results about a run are written to: its own, or one to which what it is made of is copied.

    Args:
        run (str or Path): run directory, or ``"pretrained:NAME"``.
        out (str or Path, optional): the other folder.

    Raises:
        ValueError: if a pretrained run comes without another folder.
        RunDirectoryError: as :func:`copy_run` and :func:`~torchrl_koap.training.run_lookup.find_run`.
    """
    source = find_run(run)
    if out is not None:
        return copy_run(source, out)
    if str(run).startswith(PREFIX):
        raise ValueError(f"nothing is written into {run}: name a folder of your own with --out")
    return source


def publish(run: str | Path, folder: str | Path, card: str, *, candidates: int | None = None) -> Path:
    """Writes a trained policy as the repository holds it: compact weights, options, a model card.

    Of the places where the run, its data and a planner that it took over were, the last part of the path is kept: where
    they were on another machine tells nobody anything.

    Args:
        run (str or Path): run directory of ``koap train``.
        folder (str or Path): folder to write, new or that of an earlier policy; its name is that of the policy.
        card (str): text of the ``README.md``: data, updates, success, command.

    Keyword Args:
        candidates (int, optional): plans sampled whenever one is due, unless told otherwise. Default: as trained.

    Returns:
        Path: the folder.
    """
    folder = Path(folder)
    (folder / "config.json").unlink(missing_ok=True)  # another policy of that name gives way
    folder = copy_run(run, folder)
    published = RunDirectory(folder)
    config = published.read_json("config.json")
    places = {name: Path(config[name]).name for name in PLACES if config.get(name) is not None}
    published.write_json("config.json", config | places | ({"candidates": candidates} if candidates else {}))
    for name in WEIGHTS:
        if (folder / name).exists():
            tensors, about = load_tensors(folder / name)
            # a closed-form decoder was fitted to features of exactly these frequencies: of them nothing is rounded
            only = ("covariance_root",) if name == "controller.safetensors" and (folder / WEIGHTS[0]).exists() else ()
            save_tensors(folder / name, compact(tensors, only=only), about)
    write_digests(published)
    (folder / "README.md").write_text(card)
    return folder
