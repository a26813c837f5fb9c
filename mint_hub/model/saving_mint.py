"""Saving with the code: repositories that work where mint_hub is not installed."""

import shutil
from os import PathLike
from pathlib import Path
from typing import Any

from transformers.utils import PushToHubMixin


class SavesCode:
    """Adds ``remote_code=True`` to `save_pretrained` and `push_to_hub` of a transformers class.

    With it, the folder or repository also carries the Python files it needs, and transformers
    loads it anywhere with ``trust_remote_code=True``. Where mint_hub is imported, its own classes
    are used all the same. Without it (the default) only weights and configurations are written.
    """

    def save_pretrained(
        self,
        save_directory: str | PathLike[str],
        *args: Any,
        remote_code: bool = False,
        **kwargs: Any,
    ) -> Any:
        """Save as transformers does; with ``remote_code`` also the code.

        Raises:
            ValueError: ``remote_code`` together with ``push_to_hub``, which would upload too early.
        """
        if remote_code and kwargs.get("push_to_hub"):
            raise ValueError(
                "remote_code: expected without push_to_hub=True; call .push_to_hub(repo, "
                "remote_code=True) instead"
            )
        saved = super().save_pretrained(save_directory, *args, **kwargs)  # pyright: ignore
        if remote_code:
            _write_code(save_directory)
        return saved

    def push_to_hub(self, repo_id: str, *, remote_code: bool = False, **kwargs: Any) -> Any:
        """Push as transformers does; with ``remote_code`` also the code, in the same commit."""
        if not remote_code:
            return super().push_to_hub(repo_id, **kwargs)  # pyright: ignore
        kwargs.setdefault("commit_message", f"Upload {type(self).__name__} and its code")
        return _WithCode(self).push_to_hub(repo_id, **kwargs)


class _WithCode(PushToHubMixin):
    """What is uploaded in place of an object, so that its code comes along."""

    def __init__(self, saved: Any) -> None:
        self.saved = saved

    def save_pretrained(self, save_directory: str | PathLike[str], **kwargs: Any) -> None:
        self.saved.save_pretrained(save_directory, remote_code=True, **kwargs)


def _write_code(folder: str | PathLike[str]) -> None:
    try:
        from mint_hub.model.remote_code import write_remote_code
    except ImportError:  # this file is itself a copy, and its neighbours are the code
        for file in Path(__file__).parent.glob("[!_]*.py"):
            shutil.copy(file, folder)
    else:
        write_remote_code(folder)
