# This source code is licensed under the MIT license found in the LICENSE file.
"""Tries wheel and sdist outside of the repository; ``make dist`` calls this.

In a fresh environment with the dependencies of this one, the package is imported from the wheel, the command line runs
and data files are found. Commands that need the repository must fail with one line.
"""

import subprocess
import sys
import tarfile
import tempfile
import venv
import zipfile
from pathlib import Path

WANTED = (
    "torchrl_koap/py.typed",
    "torchrl_koap/envs/evaluation_contexts.json",
    "torchrl_koap/studies/paper_results.json",
    "torchrl_koap/reports/templates/run.html",
    "torchrl_koap/reports/templates/style.css",
)
UNWANTED = ("tests/", "shared/", "pretrained/", "docs/", "benchmarks/", "examples/", "runs/")
SCRIPT = """
import tempfile, torchrl_koap
from pathlib import Path
from torchrl_koap.envs.contexts import evaluation_contexts
from torchrl_koap.reports.run_report import write_report
from torchrl_koap.studies.paper import paper_points
from torchrl_koap.tasks import get_task
assert "site-packages" in torchrl_koap.__file__, torchrl_koap.__file__
assert len(evaluation_contexts(get_task("aligning"))) >= 60
with tempfile.TemporaryDirectory() as folder:
    Path(folder, "eval.json").write_text('{"rates": {"success": {"rate": 0.5, "episodes": 2}}}')
    assert "50.0 %" in write_report(folder).read_text()
print(torchrl_koap.__version__)
"""


def check_files(dist: Path) -> Path:
    """Checks the contents of both files; returns the wheel."""
    (wheel,), (sdist,) = dist.glob("*.whl"), dist.glob("*.tar.gz")
    with zipfile.ZipFile(wheel) as file:
        names = file.namelist()
    missing = [name for name in WANTED if name not in names]
    foreign = [name for name in names if name.startswith(UNWANTED)]
    if missing or foreign:
        raise SystemExit(f"{wheel.name}: missing {missing}, should not hold {foreign}")
    with tarfile.open(sdist) as file:
        names = [name.partition("/")[2] for name in file.getnames()]
    missing = [name for name in (*WANTED, "LICENSE", "README.md", "pyproject.toml") if name not in names]
    foreign = [name for name in names if name.startswith(("shared/", "runs/", "pretrained/"))]
    if missing or foreign:
        raise SystemExit(f"{sdist.name}: missing {missing}, should not hold {foreign}")
    return wheel.resolve()


def main(dist: Path) -> None:
    """Installs the wheel and tries it."""
    wheel = check_files(dist)
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        venv.create(home / "venv", with_pip=True)
        binary = home / "venv" / "bin"
        (site,) = (home / "venv" / "lib").glob("python*/site-packages")
        # makes the packages installed here available there, without this repository
        (site / "dependencies.pth").write_text("\n".join(path for path in sys.path if path.endswith("site-packages")))
        words = ("-m", "pip", "install", "--quiet", "--no-deps", "--no-index", wheel)
        subprocess.run([binary / "python", *words], check=True, cwd=home)
        version = call(home, binary / "python", "-c", SCRIPT)
        if version not in call(home, binary / "koap", "--version"):
            raise SystemExit("koap --version differs from the package's version")
        if "curve" not in call(home, binary / "koap", "--help"):
            raise SystemExit("koap --help does not list the commands")
        refused = subprocess.run(
            [binary / "koap", "eval", "pretrained:avoiding", "--out", "eval"], cwd=home, capture_output=True, text=True
        )
        if refused.returncode != 1 or "part of the repository" not in refused.stderr:
            raise SystemExit(f"a pretrained policy without the repository: {refused.stdout}{refused.stderr}")
    sys.stdout.write(f"{wheel.name} and sdist are good: imports, commands, data files\n")


def call(home: Path, *command: object) -> str:
    """Runs a command that must succeed; returns its output."""
    done = subprocess.run([str(word) for word in command], cwd=home, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{command[0]} failed:\n{done.stderr[-3000:]}")
    return done.stdout.strip()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
