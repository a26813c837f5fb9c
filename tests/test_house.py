"""The house keeps its rules: formatting, types, layers, and how the package may be imported."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
CODE = ["mint_hub", "loaders", "tests", "benchmarks"]


def run(*command: str, cwd: Path = ROOT, **environment: str) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, **environment}
    return subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True, check=False)


def python(code: str, cwd: Path = ROOT, **environment: str) -> subprocess.CompletedProcess[str]:
    return run(sys.executable, "-c", code, cwd=cwd, **environment)


def test_lint():
    done = run(sys.executable, "-m", "ruff", "check", "--output-format=concise", *CODE)
    assert done.returncode == 0, done.stdout + done.stderr


def test_format():
    done = run(sys.executable, "-m", "ruff", "format", "--check", *CODE)
    assert done.returncode == 0, done.stdout + done.stderr


def test_types():
    done = run(sys.executable, "-m", "pyright", "--pythonpath", sys.executable)
    if "npm" in done.stderr and "error:" not in done.stdout and not os.environ.get("CI"):
        pytest.skip("pyright could not fetch itself from the npm registry")
    assert done.returncode == 0, done.stdout + done.stderr


def test_layers():
    done = run(str(Path(sys.executable).parent / "lint-imports"), "--no-cache")
    assert done.returncode == 0, done.stdout + done.stderr


def test_import_is_light():
    heavy = "['torch', 'transformers', 'datasets', 'cv2', 'av', 'scipy']"
    done = python(f"import sys, mint_hub; print([m for m in {heavy} if m in sys.modules])")
    assert done.stdout.strip() == "[]", done.stdout + done.stderr


def test_geometry_needs_no_torch():
    names = sorted(p.stem for p in (ROOT / "mint_hub/geometry").glob("*.py") if p.stem[0] != "_")
    imports = "; ".join(f"import mint_hub.geometry.{name}" for name in names)
    done = python(f"import sys; {imports}; print('torch' in sys.modules)")
    assert done.stdout.strip() == "False", done.stderr


def test_loaders_answers_to_one_name(tmp_path):
    done = python("import loaders")
    assert done.returncode != 0
    assert "this package is mint_hub.loaders" in done.stderr
    done = python("import mint_hub.loaders.schema as s; print(s.Episode.__module__)")
    assert done.stdout.strip() == "mint_hub.loaders.schema", done.stderr


def test_loaders_is_a_link():
    link = ROOT / "mint_hub/loaders"
    assert link.is_symlink()
    assert os.readlink(link) == "../loaders"


def test_version_is_said_once():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert (
        project["tool"]["setuptools"]["dynamic"]["version"]["attr"]
        == "mint_hub._version.__version__"
    )
    import mint_hub

    assert f"## {mint_hub.__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_works_without_pillow_and_torchvision():
    """The main path imports neither, nor anything else optional."""
    code = """
import sys
for name in ("PIL", "torchvision", "matplotlib", "rerun", "accelerate", "smplx"):
    sys.modules[name] = None  # as if it were not installed
import numpy as np, torch
import mint_hub
from transformers import pipeline
model = mint_hub.MintModel(mint_hub.MintConfig.tiny(encoder_layers=1, aggregator_layers=1))
episode = pipeline("egocentric-hands", model=model)(np.zeros((3, 48, 64, 3), np.uint8))
print(episode.num_frames)
"""
    done = python(code)
    assert done.stdout.strip() == "3", done.stderr
