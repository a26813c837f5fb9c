"""The common tests of the installed transformers, out of its source distribution.

Wheels of transformers leave its tests out, and the source distribution leaves some of their helpers
out. Nothing of either is kept here: the distribution is looked for in $MINT_HUB_TRANSFORMERS_SDIST,
then in the user's cache, then downloaded into it with pip. Its test modules are imported under the
package name `transformers_common_tests`, beside stand-ins for the helpers it lacks, so they do not
meet our own `tests`.
"""

import functools
import importlib
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from types import ModuleType
from unittest import mock

import pytest
import transformers

PACKAGE = "transformers_common_tests"
VERSION = transformers.__version__
MODULES = (
    "test_configuration_common",
    "test_modeling_common",
    "test_processing_common",
    "test_video_processing_common",
)
COMMON_CONFIGURATION = {
    "architectures": ["SomeModel"],
    "chunk_size_feed_forward": 3,
    "dtype": "float16",
    "id2label": {0: "left", 1: "right"},
    "label2id": {"left": 0, "right": 1},
    "output_attentions": True,
    "output_hidden_states": True,
    "problem_type": "regression",
    "return_dict": False,
}
"""What every configuration takes, none of it at its default."""


class UnobtainableError(Exception):
    """The source distribution is neither here nor to be had."""


def load(name: str) -> ModuleType:
    """One of `MODULES`; without it the calling module is skipped, or fails where $CI is true."""
    folder = _folder_or_reason()
    if isinstance(folder, UnobtainableError):
        if os.environ.get("CI", "").lower() in ("true", "1"):
            raise folder
        pytest.skip(str(folder), allow_module_level=True)
    _register_stand_ins(folder)
    path = list(sys.path)
    finder = "transformers.utils.direct_transformers_import"
    replaced = mock.patch(finder, return_value=transformers)
    try:
        with replaced:  # it would look for a repository of transformers around the module
            return importlib.import_module(f"{PACKAGE}.{name}")
    finally:
        sys.path[:] = path  # the modules add folders of that repository


@functools.cache
def _folder_or_reason() -> Path | UnobtainableError:
    """Try once, not once a module."""
    try:
        return tests_folder()
    except UnobtainableError as reason:
        return reason


def tests_folder() -> Path:
    """The folder that holds `MODULES` of the installed version, downloaded if need be."""
    given = os.environ.get("MINT_HUB_TRANSFORMERS_SDIST")
    if given:
        folder = Path(given) / "tests"
        if missing := _missing(folder):
            raise UnobtainableError(
                f"MINT_HUB_TRANSFORMERS_SDIST={given} has no tests/{missing[0]}"
            )
        return folder
    default = Path.home() / ".cache"
    cache = Path(os.environ.get("XDG_CACHE_HOME") or default) / "mint-hub"
    folder = cache / f"transformers-{VERSION}" / "tests"
    if _missing(folder):
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache) as scratch:
            archive = _download(Path(scratch))
            _unpack(archive, Path(scratch), folder)
    return folder


def _missing(folder: Path) -> list[str]:
    return [f"{name}.py" for name in MODULES if not (folder / f"{name}.py").is_file()]


def _download(folder: Path) -> Path:
    """Fetch the archive with pip, which knows the user's index (it also computes its metadata)."""
    wanted = f"transformers=={VERSION}"
    options = ["--quiet", "--no-deps", "--no-binary", "transformers", "--dest", str(folder)]
    command = [sys.executable, "-m", "pip", "download", *options, wanted]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
        last = (done.stderr.strip().splitlines() or ["no output"])[-1]
    except subprocess.TimeoutExpired:
        last = "no answer within 300 s"
    archives = list(folder.glob("*.tar.gz"))
    if not archives:
        raise UnobtainableError(f"the source distribution of {wanted} cannot be downloaded: {last}")
    return archives[0]


def _unpack(archive: Path, scratch: Path, folder: Path) -> None:
    """Take `MODULES` out of the archive; the folder appears complete or not at all."""
    top = f"transformers-{VERSION}/tests"
    wanted = {f"{top}/{name}.py" for name in MODULES}
    with tarfile.open(archive) as opened:
        members = [member for member in opened if member.isfile() and member.name in wanted]
        opened.extractall(scratch, members, filter="data")
    if missing := _missing(scratch / top):
        raise UnobtainableError(f"{archive.name} has no tests/{missing[0]}")
    folder.parent.mkdir(parents=True, exist_ok=True)
    if _missing(folder):  # else another process was faster
        shutil.rmtree(folder, ignore_errors=True)
        (scratch / top).rename(folder)


def _register_stand_ins(folder: Path) -> None:
    """Enter the package, and what its modules import that the distribution does not carry."""
    if PACKAGE in sys.modules:
        return
    package = ModuleType(PACKAGE)
    package.__path__ = [str(folder)]
    sys.modules[PACKAGE] = package
    mixins = {
        "exporters.test_export": "ExportTesterMixin",
        "generation.test_utils": "GenerationTesterMixin",
    }
    contents = {name: {mixin: type(mixin, (), {})} for name, mixin in mixins.items()}
    contents["utils.test_configuration_utils"] = {"config_common_kwargs": COMMON_CONFIGURATION}
    for name, values in contents.items():
        parent = name.partition(".")[0]
        for full in (parent, name):
            sys.modules[f"{PACKAGE}.{full}"] = ModuleType(f"{PACKAGE}.{full}")
        vars(sys.modules[f"{PACKAGE}.{name}"]).update(values)
    hub = sys.modules["fetch_hub_objects_for_ci"] = ModuleType("fetch_hub_objects_for_ci")
    hub.url_to_local_path = lambda url: url
