"""The rule that nothing is skipped that README.md does not list, and the markers of the tests."""

import re
from collections.abc import Generator, Iterator
from fnmatch import fnmatchcase
from pathlib import Path

import pytest
import torch

MARKERS = (
    "accelerate_tests",
    "flash_attn_test",
    "flash_attn_3_test",
    "flash_attn_4_test",
    "torch_compile_test",
)
NEVER_SKIPPED = (
    "test_batching_equivalence",
    "test_determinism",
    "test_eager_matches_sdpa_*",
    "test_gradient_checkpointing_*",
    "test_*_gradient_checkpointing*",
    "test_save_load*",
    "test_torch_save_load",
    "test_video_processor_save_load*",
    "test_*from_and_save_pretrained*",
)
INAPPLICABLE, LACKING = "Does not apply to MINT", "Needs what a plain CPU machine lacks"


def pytest_configure(config: pytest.Config) -> None:
    for marker in MARKERS:
        config.addinivalue_line("markers", f"{marker}: of the common tests of transformers")


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    """Tensors this small are slower in several threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def listed() -> dict[str, list[str]]:
    """Patterns of test names in README.md, by section."""
    text = (Path(__file__).parent / "README.md").read_text(encoding="utf-8")
    found: dict[str, list[str]] = {}
    for section in text.split("\n### ")[1:]:
        title, _, body = section.partition("\n")
        rows = (line.split("|")[1] for line in body.splitlines() if line.startswith("| `"))
        found[title] = [name for row in rows for name in re.findall(r"`([^`]+)`", row)]
    return found


LISTED = listed()


def matches(name: str, patterns: tuple[str, ...] | list[str]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def fault(name: str, skipped: bool) -> str | None:
    """What is wrong with a test of the mixins being skipped, or not."""
    inapplicable = matches(name, LISTED[INAPPLICABLE])
    if skipped and matches(name, NEVER_SKIPPED):
        return "it may never be skipped"
    if skipped and not inapplicable and not matches(name, LISTED[LACKING]):
        return "it is skipped, and README.md does not list it"
    if not skipped and inapplicable:
        return "README.md lists it as inapplicable, and it ran"
    return None


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    decided = report.skipped or (report.when == "call" and report.passed)
    if getattr(item, "cls", None) is not None and decided:
        problem = fault(item.name, report.skipped)
        if problem is not None:
            report.outcome = "failed"
            report.longrepr = f"{item.name}: {problem} ({report.longrepr})"
    return report
