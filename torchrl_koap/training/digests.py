# This source code is licensed under the MIT license found in the LICENSE file.
"""Checksums of what a finished run is made of: a bit that has flipped, or an option edited since, does not go unseen.

``digests.json`` is the last file of a training and is taken away before the next one begins in the folder, so that what
it says is always of one piece. Runs of earlier versions have none.
"""

from __future__ import annotations

from torchrl_koap.files import sha256_of
from torchrl_koap.training.run_directory import RunDirectory, RunDirectoryError

DIGESTS = "digests.json"
OF = ("config.json", "summary.json", "planner.safetensors", "controller.safetensors", "eigenvalues.safetensors")


def write_digests(run: RunDirectory) -> None:
    """Keeps the checksums of a run that has just been finished.

    Args:
        run (RunDirectory): the run.
    """
    run.write_json(DIGESTS, {name: sha256_of(run.path / name) for name in OF if (run.path / name).is_file()})


def forget_digests(run: RunDirectory) -> None:
    """Takes the checksums away, before the files they are of are written anew.

    Args:
        run (RunDirectory): the run.
    """
    (run.path / DIGESTS).unlink(missing_ok=True)


def changed_files(run: RunDirectory) -> list[str]:
    """What is no longer as the training left it.

    Args:
        run (RunDirectory): the run.

    Returns:
        list of str: names of files; none for a run without checksums.

    Raises:
        RunDirectoryError: if the checksums themselves are damaged.

    Examples:
        >>> import tempfile
        >>> from torchrl_koap.training.digests import changed_files, write_digests
        >>> from torchrl_koap.training.run_directory import RunDirectory
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     run = RunDirectory(folder)
        ...     run.write_json("summary.json", {"steps": 3})
        ...     write_digests(run)
        ...     before = changed_files(run)
        ...     run.write_json("summary.json", {"steps": 4})
        ...     before, changed_files(run)
        ([], ['summary.json'])
    """
    if not (run.path / DIGESTS).exists():
        return []
    known = run.read_json(DIGESTS)
    return [name for name in OF if name in known and _digest(run, name) != known[name]]


def check_digests(run: RunDirectory) -> None:
    """Refuses a run whose files are not those of its training.

    Args:
        run (RunDirectory): the run.

    Raises:
        RunDirectoryError: naming the files.
    """
    changed = changed_files(run)
    if changed:
        raise RunDirectoryError(
            f"{run.path}: {', '.join(changed)} changed since the training ended (compared with {DIGESTS}); restore"
            f" what was there, train again, or delete {run.path / DIGESTS} if the change was meant"
        )


def _digest(run: RunDirectory, name: str) -> str | None:
    return sha256_of(run.path / name) if (run.path / name).is_file() else None
