"""Fixtures shared by the whole suite."""

import os
from pathlib import Path

import pytest

TESTS = Path(__file__).parent


@pytest.fixture(scope="session")
def golden_dir() -> Path:
    """Golden numbers that travel with the repository."""
    return TESTS / "golden"


@pytest.fixture(scope="session")
def real_dir() -> Path:
    """The folder of real clips, which may not be shipped: $MINT_HUB_REAL, or beside us."""
    default = TESTS.parent.parent / "shared" / "real"
    folder = Path(os.environ.get("MINT_HUB_REAL", default))
    if not folder.is_dir():
        pytest.skip(f"no real clips at {folder} (set MINT_HUB_REAL); they may not be shipped")
    return folder
