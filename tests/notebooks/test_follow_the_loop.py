"""The notebook runs, at a size at which nothing is learned; and it is a notebook."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOK = ROOT / "notebooks" / "follow_the_loop.py"
REASON = "the extra 'learn' is not installed: stable-baselines3, torch, jupytext"


def test_notebook_runs_and_the_drive_is_the_episode(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason=REASON)
    pytest.importorskip("stable_baselines3", reason=REASON)
    done = run(tmp_path)
    assert done.returncode == 0, done.stderr
    assert "| reference follower | 1 of 1 |" in done.stdout
    assert (tmp_path / "runs" / "learn" / "loop.policy").is_file()
    assert (tmp_path / "runs" / "learn" / "start.png").is_file()


def test_without_the_extra_the_first_half_runs_and_the_rest_says_what_to_install(tmp_path: Path) -> None:
    (tmp_path / "stable_baselines3.py").write_text("raise ImportError('not here')\n")
    done = run(tmp_path, PYTHONPATH=f"{tmp_path}{os.pathsep}{ROOT}")
    assert done.returncode == 1
    assert done.stderr.strip().splitlines()[-1].startswith("stable-baselines3 is not installed; install the extra")
    assert "after 20.0 s" in done.stdout


def test_it_is_a_notebook_with_words_between_its_cells() -> None:
    jupytext = pytest.importorskip("jupytext", reason=REASON)
    cells = jupytext.read(NOTEBOOK, fmt="py:percent").cells
    kinds = [cell.cell_type for cell in cells]
    assert kinds[0] == "markdown"
    assert kinds.count("markdown") >= 8
    assert kinds.count("code") >= 8
    for cell in cells:
        if cell.cell_type == "code":
            compile(cell.source, str(NOTEBOOK), "exec")


def run(folder: Path, **env: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, NOTEBOOK],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "FAIRWAY_NOTEBOOK_STEPS": "2000"} | env,
        text=True,
        capture_output=True,
        timeout=300,
        check=False,
    )
