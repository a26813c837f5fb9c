"""`load_dataset("mint-ego")`: the name that `datasets` answers.

Two doors lead to one builder (``mint_hub.loaders.builder``) and give the same rows:

- ``datasets.load_dataset("mint-ego", config)`` after ``import mint_hub``. The library has no public
  way to add a name, so ``answer_name`` wraps one function of it; nothing else is touched.
- ``mint_hub.load_dataset(config)``, which uses only what the library documents.

Where the corpus lies is said in ``mint_hub.loaders.location``; the config "sample" is embedded.
"""

import functools
import os
import warnings
from collections.abc import Callable
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    import datasets

    Loaded = (
        datasets.Dataset
        | datasets.DatasetDict
        | datasets.IterableDataset
        | datasets.IterableDatasetDict
    )

NAME: Final = "mint-ego"


def load_dataset(
    config: str | None = None,
    split: str | None = None,
    *,
    streaming: bool = False,
    location: str | os.PathLike[str] | None = None,
    revision: str | None = None,
    token: str | bool | None = None,
    cache_dir: str | os.PathLike[str] | None = None,
    num_proc: int | None = None,
) -> "Loaded":
    """Load the corpus as ``datasets`` does, through its documented interface alone.

    Columns are the public fields of ``Episode``, and ``builder.episode_of(row)`` makes it.

    Args:
        config: one of ``location.CONFIGS``, or another that the location has; default: "sample".
        split: "train", "validation", a slice such as "train[:10%]"; default: all, in a dict.
        streaming: read shards while iterating, instead of preparing a cache first.
        location: folder, hub id ("org/name") or address; default: $MINT_EGO_LOCATION, else
            ``location.LOCATION``.
        revision: branch, tag or commit, where the location is a repository of the hub.
        token: token for a gated or private repository.
        cache_dir: where the prepared dataset is kept; default: the library's own cache.
        num_proc: processes that prepare the cache.

    Raises:
        ValueError: there is no such location, config or split; the message says what there is.
        CorpusError: a shard is missing or shorter than it was written.

    """
    from mint_hub.loaders.builder import MintEgo

    if streaming and num_proc is not None:
        raise ValueError("num_proc: expected none with streaming=True, which prepares nothing")
    builder = MintEgo(
        config_name=config,
        location=location,
        revision=revision,
        token=token,
        cache_dir=None if cache_dir is None else os.fspath(cache_dir),
        **builder_identity(),
    )
    if streaming:
        return builder.as_streaming_dataset(split=split)  # pyright: ignore[reportReturnType]
    builder.download_and_prepare(num_proc=num_proc)
    return builder.as_dataset(split=split)  # pyright: ignore[reportArgumentType]


def builder_identity() -> dict[str, str]:
    """Return what names the builder's cache, the same through both doors."""
    from mint_hub.loaders.schema import SCHEMA_VERSION

    return {"dataset_name": NAME, "hash": f"schema-{SCHEMA_VERSION}"}


# ------------------------------------------------------------------------------ the name


def answer_name(module: ModuleType) -> None:
    """Make the factory in ``datasets.load`` (or its copy in ``datasets.inspect``) know NAME.

    Idempotent. Any other name goes to the library's own function. Where a future version has no
    such function, a warning says so and ``mint_hub.load_dataset`` still works.
    """
    stock: Callable[..., Any] | None = getattr(module, "dataset_module_factory", None)
    if stock is None:
        warnings.warn(
            f"{module.__name__} has no dataset_module_factory, so load_dataset({NAME!r}) is not "
            "available with this version of datasets: use mint_hub.load_dataset",
            stacklevel=2,
        )
        return
    if getattr(stock, "answers", None) == NAME:
        return

    @functools.wraps(stock)
    def factory(path: str, revision: Any = None, *args: Any, **kwargs: Any) -> Any:
        if path != NAME:
            return stock(path, revision, *args, **kwargs)
        from datasets.load import DatasetModule

        identity = builder_identity()
        options = {"dataset_name": identity["dataset_name"], "revision": revision}
        return DatasetModule("mint_hub.loaders.builder", identity["hash"], options)

    vars(factory)["answers"] = NAME
    vars(module)["dataset_module_factory"] = factory
