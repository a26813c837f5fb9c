"""A renderer for the tests of this folder, or the reason why there is none."""

from collections.abc import Iterator

import pytest

from mint_hub.synth.render import Renderer
from tests.small_world import SIZE_HW, renderer_or_skip


@pytest.fixture(scope="session")
def renderer() -> Iterator[Renderer]:
    with renderer_or_skip(SIZE_HW) as made:
        yield made
