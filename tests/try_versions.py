# This source code is licensed under the MIT license found in the LICENSE file.
"""Tries the lowest and newest dependencies on every installed Python; ``make test-matrix`` calls this.

    python tests/try_versions.py
    python tests/try_versions.py --pythons 3.11 --torch 2.13.0+cpu

For each pair, ``uv`` resolves compatible versions, wheels only. If torch resolves to a CPU wheel (``UV_FIND_LINKS``, or
``UV_TORCH_BACKEND=cpu`` with network access), they are installed and a fast part of the suite runs. Otherwise the pair
is only resolved, since CUDA is gigabytes that no test needs, and the table says so.
"""

import argparse
import csv
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
PYTHONS = ("3.11", "3.12", "3.13")
STRATEGIES = {"lowest": "lowest-direct", "newest": "highest"}
TESTS = (
    *("tests/test_keys.py", "tests/test_files.py", "tests/test_lookup.py", "tests/tasks", "tests/modules"),
    *("tests/objectives", "tests/data", "tests/envs/test_avoiding.py", "tests/training/test_loop.py"),
)
TOOLS = ("pytest", "pytest-timeout", "hypothesis")
EXTRAS = ("--extra", "lerobot", "--extra", "hdf5")
SHOWN = ("torch", "torchrl", "numpy", "scipy", "mujoco", "dm-control", "gymnasium", "numba", "matplotlib")
COLUMNS = ("python", "versions", "outcome", "passed", "failed", *SHOWN)


def uv(*words: object) -> subprocess.CompletedProcess[str]:
    """Calls uv, which must be installed."""
    found = shutil.which("uv") or str(Path(sys.executable).parent / "uv")
    return subprocess.run([found, *map(str, words)], cwd=ROOT, capture_output=True, text=True)


def resolve(python: str, versions: str, torch: str | None, folder: Path) -> tuple[Path, dict[str, str], str]:
    """Returns a file of compatible versions, the versions by name, and the reason if there are none."""
    made, constraint = folder / "versions.txt", folder / "torch.txt"
    constraint.write_text(f"torch=={torch}\n" if torch else "")
    done = uv(
        *("pip", "compile", "--no-build", "--no-annotate", "--no-header", "--resolution", STRATEGIES[versions]),
        *("--python-version", python, "--constraint", constraint, "--output-file", made),
        *EXTRAS,
        "pyproject.toml",
    )
    if done.returncode:
        return made, {}, done.stderr.strip().replace("\n", " ")[:200]
    return made, dict(re.findall(r"^([\w.-]+)==(\S+)", made.read_text(), re.MULTILINE)), ""


def run_tests(python: str, versions: Path, folder: Path) -> tuple[str, int, int]:
    """Installs the versions and runs tests; returns the outcome and the numbers of passed and failed tests."""
    home = folder / "venv"
    for words in (
        ("venv", "--quiet", "--python", python, home),
        ("pip", "install", "--quiet", "--python", home, "--no-deps", "--requirement", versions),
        ("pip", "install", "--quiet", "--python", home, *TOOLS, "--constraint", versions),
        ("pip", "install", "--quiet", "--python", home, "--no-deps", "dm-control", "--constraint", versions),
        ("pip", "install", "--quiet", "--python", home, "--no-deps", "--editable", ROOT),
    ):
        done = uv(*words)
        if done.returncode:
            return f"not installed: {done.stderr.strip()[-200:]}", 0, 0
    words = [home / "bin" / "python", "-m", "pytest", "-q", "-p", "no:cacheprovider", *TESTS]
    done = subprocess.run(list(map(str, words)), cwd=ROOT, capture_output=True, text=True)
    sys.stdout.write("\n".join(done.stdout.splitlines()[-30:]) + "\n")
    counts = {word: int(number) for number, word in re.findall(r"(\d+) (passed|failed|error)", done.stdout)}
    failed = counts.get("failed", 0) + counts.get("error", 0)
    return "tests ran" if counts else f"pytest: {done.stderr[-200:]}", counts.get("passed", 0), failed


def main() -> int:
    """Tries all pairs; returns 1 if a test failed or no versions are compatible."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pythons", nargs="+", default=PYTHONS)
    parser.add_argument("--torch", help="version of the CPU wheels that are at hand (default: as resolved)")
    parser.add_argument("--table", type=Path)
    options = parser.parse_args()
    rows = []
    for python in options.pythons:
        for versions in STRATEGIES:
            with tempfile.TemporaryDirectory() as name:
                made, found, problem = resolve(python, versions, options.torch, Path(name))
                row = {"python": python, "versions": versions, "outcome": f"does not resolve: {problem}"}
                if found:
                    row["outcome"] = "resolved"
                    if "+cpu" in found["torch"]:
                        row["outcome"], row["passed"], row["failed"] = run_tests(python, made, Path(name))
            rows.append(row | {package: found.get(package, "") for package in SHOWN})
            sys.stdout.write(" ".join(str(value) for value in rows[-1].values()) + "\n")
            sys.stdout.flush()
            if options.table:
                with options.table.open("w", newline="") as file:
                    writer = csv.DictWriter(file, COLUMNS)
                    writer.writeheader()
                    writer.writerows(rows)
    return int(any(row.get("failed") or row["outcome"] not in ("resolved", "tests ran") for row in rows))


if __name__ == "__main__":
    sys.exit(main())
