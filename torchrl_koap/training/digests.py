# This source code is licensed under the MIT license found in the LICENSE file.
"""Checksums of what a finished run is made of: a bit that has flipped, or an option edited since, does not go unseen.

``digests.json`` is the last file of a training. A run that is resumed ends with the same bytes, so that it stays true;
it is taken away only where other data are insisted on. Runs of earlier versions have none.
"""

from __future__ import annotations

import hashlib
import json

from torchrl_koap.files import sha256_of
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError
from torchrl_koap.training.resume import FREE

DIGESTS = "digests.json"
OF = ("config.json", "planner.safetensors", "controller.safetensors", "eigenvalues.safetensors")


def write_digests(run: RunDirectory) -> None:
    """Keeps the checksums of a run that has just been finished.

    Args:
        run (RunDirectory): the run.
    """
    run.write_json(DIGESTS, {name: _digest(run, name) for name in OF if (run.path / name).is_file()})


def forget_digests(run: RunDirectory) -> None:
    """Takes the checksums away, before other files are written than those they are of.

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
        >>> from torchrl_koap.runs.run_directory import RunDirectory
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     run = RunDirectory(folder)
        ...     run.write_json("config.json", {"steps": 3, "threads": 1})
        ...     write_digests(run)
        ...     run.write_json("config.json", {"steps": 3, "threads": 2})  # it may be resumed so
        ...     before = changed_files(run)
        ...     run.write_json("config.json", {"steps": 4, "threads": 1})
        ...     before, changed_files(run)
        ([], ['config.json'])
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
    if name != "config.json":
        return sha256_of(run.path / name) if (run.path / name).is_file() else None
    content = {key: value for key, value in run.read_json(name).items() if key not in FREE}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
