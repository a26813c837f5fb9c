"""The package as loose files in a model repository, for `trust_remote_code=True`.

transformers copies a repository's Python files into one folder and follows imports of the form
``from .name import x`` there, found by a regular expression; packages within packages, data files
and imports of mint_hub itself do not survive that. So each module that the public classes reach
becomes one flat file with its imports rewritten, and files of `mint_hub.assets` become text.

Works on source text: nothing is imported, and nothing but the imports is changed. A module that
only mint_hub itself can use, this one, is left out: its import must stand in a ``try``.
"""

import ast
import json
import zlib
from base64 import b85encode
from functools import cache
from os import PathLike
from pathlib import Path
from typing import Any, Final

from .._version import __version__

PACKAGE: Final = Path(__file__).resolve().parent.parent
LEFT_OUT: Final = frozenset({"mint_hub.model.remote_code"})
ASSETS: Final = ("hand_template.safetensors",)
TASK: Final = "egocentric-hands"

AUTO_CLASSES: Final = {
    "AutoConfig": ("mint_hub.model.configuration_mint", "MintConfig"),
    "AutoModel": ("mint_hub.model.modeling_mint", "MintModel"),
    "AutoVideoProcessor": ("mint_hub.model.processing_mint", "MintVideoProcessor"),
    "AutoProcessor": ("mint_hub.model.processing_mint", "MintProcessor"),
}
PIPELINE: Final = ("mint_hub.inference.pipeline_mint", "EgocentricHandsPipeline")

_COPIED = "# Copied from {module} {version} (Apache-2.0): pip install mint-hub\n"
_ASSETS_MODULE = '''"""Files of mint_hub.assets as text: transformers copies Python files only."""

import zlib
from base64 import b85decode

FILES = {{
{entries}
}}


def read_asset(name: str) -> bytes:
    """Read a file that would lie in mint_hub/assets."""
    return zlib.decompress(b85decode("".join(FILES[name].split())))
'''


def write_remote_code(folder: str | PathLike[str]) -> list[Path]:
    """Write the code into a saved model, processor or pipeline, and name it in its configurations.

    Args:
        folder: what `save_pretrained` wrote. Files of an earlier call are replaced.

    Returns:
        The Python files.
    """
    folder = Path(folder)
    written = []
    for name, source in remote_files().items():
        path = folder / f"{name}.py"
        path.write_text(source, encoding="utf-8")
        written.append(path)
    for name, amend in _AMENDMENTS.items():
        path = folder / name
        if path.is_file():
            content = json.loads(path.read_text(encoding="utf-8"))
            amend(content)
            text = json.dumps(content, indent=2, sort_keys=True) + "\n"
            path.write_text(text, encoding="utf-8")
    return written


@cache
def remote_files() -> dict[str, str]:
    """Sources by flat name, of every module that the public classes reach.

    Raises:
        ValueError: an import that cannot be rewritten, or two modules of one flat name.
    """
    waiting = [module for module, _ in (*AUTO_CLASSES.values(), PIPELINE)]
    owners: dict[str, str] = {}
    files: dict[str, str] = {}
    while waiting:
        module = waiting.pop()
        name = flat_name(module)
        if owners.setdefault(name, module) != module:
            raise ValueError(f"{name}.py: would hold both {owners[name]} and {module}")
        if name in files:
            continue
        if module == "mint_hub.assets":
            source, needed = _assets_source(), set()
        else:
            source, needed = flatten(module)
        files[name] = _COPIED.format(module=module, version=__version__) + source
        waiting += sorted(needed)
    return dict(sorted(files.items()))


def flat_name(module: str) -> str:
    """Name of a module among the loose files.

    >>> flat_name("mint_hub.model.modeling_mint"), flat_name("mint_hub.geometry.rigid")
    ('modeling_mint', 'mint_geometry_rigid')
    """
    parts = [part.strip("_") for part in module.split(".")[1:]]
    return parts[-1] if parts[-1].endswith("_mint") else "_".join(["mint", *parts])


def flatten(module: str) -> tuple[str, set[str]]:
    """Rewrite a module's imports of the package, at its top and within functions.

    Returns:
        The source, and the modules it imports.

    Raises:
        ValueError: an import of the package in a form that has no flat counterpart.
    """
    path = _module_file(module)
    assert path is not None, module
    source = path.read_text(encoding="utf-8")
    lines = source.splitlines()
    needed: set[str] = set()
    nodes = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.Import | ast.ImportFrom)]
    for node in sorted(nodes, key=lambda node: -node.lineno):
        statements = _flat_statements(node, module, needed)
        if statements is None:
            continue
        first, last = node.lineno - 1, node.end_lineno - 1
        indent, rest = lines[first][: node.col_offset], lines[last][node.end_col_offset :]
        if indent.strip() or (rest.strip() and not rest.strip().startswith("#")):
            raise ValueError(f"{module}, line {node.lineno}: expected the import on its own line")
        lines[first : last + 1] = [indent + statement for statement in statements]
        lines[first + len(statements) - 1] += rest
    return "\n".join(lines) + "\n", needed


def _flat_statements(
    node: ast.Import | ast.ImportFrom, module: str, needed: set[str]
) -> list[str] | None:
    """What replaces an import, adding the modules it reaches to ``needed``; None: nothing does."""
    if isinstance(node, ast.Import):
        if any(alias.name.split(".")[0] == "mint_hub" for alias in node.names):
            raise ValueError(
                f"{module}, line {node.lineno}: expected `from mint_hub... import ...`, which has "
                f"a flat counterpart, got `{ast.unparse(node)}`"
            )
        return None
    base = _absolute(node, module)
    if base.split(".")[0] != "mint_hub" or base in LEFT_OUT:
        return None
    statements, names = [], []
    for alias in node.names:
        submodule = f"{base}.{alias.name}"
        if _module_file(submodule) is None:
            names.append(alias.name + (f" as {alias.asname}" if alias.asname else ""))
            continue
        needed.add(submodule)
        flat = flat_name(submodule)
        # transformers only sees the first of the two, which makes it copy the file.
        statements.append(f"from .{flat} import __name__ as _")
        statements.append(f"from . import {flat} as {alias.asname or alias.name}")
    if names:
        needed.add(base)
        statements.append(f"from .{flat_name(base)} import {', '.join(names)}")
    return statements


def _absolute(node: ast.ImportFrom, module: str) -> str:
    if not node.level:
        return node.module or ""
    path = _module_file(module)
    assert path is not None
    package = module.split(".") if path.name == "__init__.py" else module.split(".")[:-1]
    package = package[: len(package) - node.level + 1]
    return ".".join([*package, *([node.module] if node.module else [])])


def _module_file(module: str) -> Path | None:
    path = PACKAGE.joinpath(*module.split(".")[1:])
    for file in (path.with_suffix(".py"), path / "__init__.py"):
        if file.is_file():
            return file
    return None


def _assets_source() -> str:
    entries = []
    for name in ASSETS:
        text = b85encode(zlib.compress((PACKAGE / "assets" / name).read_bytes(), 9)).decode()
        rows = "\n".join(text[i : i + 96] for i in range(0, len(text), 96))
        entries.append(f'    "{name}": """\n{rows}\n""",')
    return _ASSETS_MODULE.format(entries="\n".join(entries))


def _reference(auto_class: str) -> str:
    module, name = AUTO_CLASSES[auto_class]
    return f"{flat_name(module)}.{name}"


def _amend_config(content: dict[str, Any]) -> None:
    content["auto_map"] = {name: _reference(name) for name in AUTO_CLASSES}
    content["custom_pipelines"] = {
        TASK: {
            "impl": f"{flat_name(PIPELINE[0])}.{PIPELINE[1]}",
            "pt": ["AutoModel"],
            "type": "multimodal",
        }
    }


def _amend_video_processor(content: dict[str, Any]) -> None:
    content["auto_map"] = {"AutoVideoProcessor": _reference("AutoVideoProcessor")}


def _amend_processor(content: dict[str, Any]) -> None:
    content["auto_map"] = {"AutoProcessor": _reference("AutoProcessor")}
    if "video_processor" in content:
        _amend_video_processor(content["video_processor"])


_AMENDMENTS: Final = {
    "config.json": _amend_config,
    "processor_config.json": _amend_processor,
    "video_preprocessor_config.json": _amend_video_processor,
}

__all__ = ["flat_name", "remote_files", "write_remote_code"]
