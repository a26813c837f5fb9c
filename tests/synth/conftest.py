"""A renderer for the tests of this folder, or the reason why there is none."""

from collections.abc import Iterator

import pytest

from mint_hub.synth.render import Renderer
from tests.small_world import SIZE_HW


@pytest.fixture(scope="session")
def renderer() -> Iterator[Renderer]:
    try:
        made = Renderer(SIZE_HW)
    except (ImportError, RuntimeError) as error:
        pytest.skip(str(error))
    with made:
        yield made
