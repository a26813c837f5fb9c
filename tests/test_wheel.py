"""A wheel, built and installed elsewhere, is the whole package."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("wheel")
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-deps",
        "-w",
        str(out),
        str(ROOT),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return next(out.glob("*.whl"))


def test_wheel_holds_the_package_once(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    for name in (
        "mint_hub/py.typed",
        "mint_hub/loaders/schema.py",
        "mint_hub/model/modeling_mint.py",
        "mint_hub/assets/hand_template.safetensors",
    ):
        assert name in names
    assert not [n for n in names if n.startswith(("loaders/", "tests/"))]
    assert any(n.endswith("licenses/LICENSE") for n in names)


def test_wheel_works_elsewhere(wheel, tmp_path):
    site = tmp_path / "site"
    command = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--target",
        str(site),
    ]
    subprocess.run([*command, str(wheel)], check=True, capture_output=True)
    code = """
import sys
sys.path.insert(0, sys.argv[1])
sys.path[:] = [p for p in sys.path if p and not p.endswith(sys.argv[2])]
sys.meta_path[:] = [f for f in sys.meta_path if 'editable' not in repr(f).lower()]
import mint_hub, mint_hub.loaders.schema
assert mint_hub.__file__.startswith(sys.argv[1]), mint_hub.__file__
from mint_hub.cli import main
raise SystemExit(main(["info"]))
"""
    done = subprocess.run(
        [sys.executable, "-c", code, str(site), str(ROOT)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "mint-hand-template" in done.stdout
