"""The package as loose files: what transformers' loader of remote code sees of them."""

import ast
from textwrap import dedent

import pytest
from transformers.dynamic_module_utils import get_imports, get_relative_imports

from mint_hub.assets import read_asset
from mint_hub.model import remote_code
from mint_hub.model.remote_code import flat_name, flatten, remote_files, write_remote_code


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("code")
    write_remote_code(folder)
    return folder


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Stand in for mint_hub: a.py, b/__init__.py, b/c.py, and d.py with the given source."""
    monkeypatch.setattr(remote_code, "PACKAGE", tmp_path)
    (tmp_path / "b").mkdir()
    for name in ("a.py", "b/__init__.py", "b/c.py"):
        (tmp_path / name).write_text("value = 1\n")

    def flattened(source: str, module: str = "mint_hub.d") -> tuple[str, set[str]]:
        path = tmp_path.joinpath(*module.split(".")[1:]).with_suffix(".py")
        path.write_text(dedent(source))
        return flatten(module)

    return flattened


def test_transformers_sees_every_import_between_the_files(folder):
    names = {path.stem for path in folder.glob("*.py")}
    assert names == set(remote_files())
    for path in folder.glob("*.py"):
        nodes = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.ImportFrom)]
        relative = {node.module for node in nodes if node.level and node.module}
        modules = {a.name for n in nodes if n.level and not n.module for a in n.names}
        assert {node.level for node in nodes} <= {0, 1}
        assert set(get_relative_imports(path)) == relative
        assert modules <= relative <= names


def test_files_require_no_more_than_is_declared(folder):
    required = {name for path in folder.glob("*.py") for name in get_imports(path)}
    assert "mint_hub" not in required
    assert required & {"rerun", "PIL", "wrapt", "datasets", "matplotlib", "torchvision"} == set()


def test_assets_come_along_as_text(folder):
    scope: dict = {}
    exec((folder / "mint_assets.py").read_text(), scope)
    for name in remote_code.ASSETS:
        assert scope["read_asset"](name) == read_asset(name)


def test_writing_again_changes_nothing(folder):
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    write_remote_code(folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_imports_are_rewritten_wherever_they_stand(package):
    source, needed = package(
        """\
        import json
        from mint_hub.a import value, value as w
        from mint_hub.b import c as see, value as v  # a remark
        from .b.c import (
            value,
        )

        def later():
            from . import a
            return a
        """
    )
    assert source == dedent(
        """\
        import json
        from .mint_a import value, value as w
        from .mint_b_c import __name__ as _
        from . import mint_b_c as see
        from .mint_b import value as v  # a remark
        from .mint_b_c import value

        def later():
            from .mint_a import __name__ as _
            from . import mint_a as a
            return a
        """
    )
    assert needed == {"mint_hub.a", "mint_hub.b", "mint_hub.b.c"}


def test_relative_imports_start_from_the_modules_own_package(package):
    source, needed = package("from ..a import value\nfrom .c import value\n", "mint_hub.b.e")
    assert source == "from .mint_a import value\nfrom .mint_b_c import value\n"
    assert needed == {"mint_hub.a", "mint_hub.b.c"}


@pytest.mark.parametrize("source", ["import mint_hub.a", "x = 1; from mint_hub.a import value"])
def test_other_forms_are_refused_by_line(package, source):
    with pytest.raises(ValueError, match=r"mint_hub\.d, line 1: expected"):
        package(source)


def test_names_of_model_files_stay():
    assert flat_name("mint_hub.model.modeling_mint") == "modeling_mint"
    assert flat_name("mint_hub.inference.pipeline_mint") == "pipeline_mint"
    assert flat_name("mint_hub._version") == "mint_version"
