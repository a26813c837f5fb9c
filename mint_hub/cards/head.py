"""What the hub's documentation says of a dataset card's head, checked without the hub.

``huggingface_hub`` checks a card by sending it to the hub; here the keys that this project uses are
held against the documented values, and configs and features against `datasets` itself.
"""

from collections.abc import Mapping
from typing import Any, Final, cast

from mint_hub.cards.sources import CardError

FIELD_TYPES: Final = ("text", "checkbox", "date_picker", "country", "select")
SIZES: Final = (
    "n<1K",
    "1K<n<10K",
    "10K<n<100K",
    "100K<n<1M",
    "1M<n<10M",
    "10M<n<100M",
)
TASKS: Final = ("robotics", "video-classification", "keypoint-detection", "other")
CREATORS: Final = (
    "found",
    "crowdsourced",
    "expert-generated",
    "machine-generated",
    "no-annotation",
    "other",
)
_ALLOWED: Final[Mapping[str, tuple[str, ...]]] = {
    "annotations_creators": CREATORS,
    "language_creators": CREATORS,
    "license": ("other", "apache-2.0"),
    "size_categories": SIZES,
    "source_datasets": ("original", "extended"),
    "task_categories": TASKS,
}
_TEXTS: Final = (
    "extra_gated_button_content",
    "extra_gated_description",
    "extra_gated_heading",
    "extra_gated_prompt",
    "license_name",
    "pretty_name",
)
_OTHERS: Final = ("configs", "dataset_info", "extra_gated_fields", "language", "tags")


def size_category(samples: int) -> str:
    """Return the hub's name for a number of samples.

    >>> size_category(560_649)
    '100K<n<1M'

    Raises:
        CardError: more than any corpus of ours has.

    """
    if (place := max(len(str(samples)) - 3, 0)) >= len(SIZES):
        raise CardError(f"samples: expected fewer than 100,000,000, got {samples:,}")
    return SIZES[place]


def check_head(head: Mapping[str, Any]) -> None:
    """Check the metadata of a dataset card.

    Raises:
        CardError: a key is unknown here, a value is not among the documented ones, a field of the
            access form has no known type, or `datasets` cannot read the configs or features.

    """
    for name, value in head.items():
        if name in _ALLOWED:
            values = cast("list[Any]", value if isinstance(value, list) else [value])
            for item in values:
                if item not in _ALLOWED[name]:
                    raise CardError(f"{name}: expected one of {list(_ALLOWED[name])}, got {item!r}")
        elif name in _TEXTS:
            if not isinstance(value, str) or not value.strip():
                raise CardError(f"{name}: expected text, got {value!r}")
        elif name not in _OTHERS:
            raise CardError(f"{name}: expected a key of a dataset card that is used here")
    if head.get("license") == "other" and "license_name" not in head:
        raise CardError("license_name: expected one beside license: other, got none")
    _check_form(head.get("extra_gated_fields", {}))
    _check_configs(head)


def _check_form(form: Any) -> None:
    if not isinstance(form, dict):
        raise CardError(f"extra_gated_fields: expected a type by field name, got {form!r}")
    for name, kind in cast("dict[str, Any]", form).items():
        entries = cast("dict[str, Any]", kind if isinstance(kind, dict) else {"type": kind})
        if entries.get("type") not in FIELD_TYPES:
            raise CardError(
                f"extra_gated_fields, {name}: expected one of {list(FIELD_TYPES)}, got {kind!r}"
            )
        if (entries["type"] == "select") != bool(entries.get("options")):
            raise CardError(f"extra_gated_fields, {name}: expected options for a select only")


def _check_configs(head: Mapping[str, Any]) -> None:
    """Read configs and features as `datasets` does when it opens a folder or a repository."""
    from datasets.info import DatasetInfosDict
    from datasets.utils.metadata import MetadataConfigs
    from huggingface_hub import DatasetCardData

    data = DatasetCardData(**head)
    try:
        configs = MetadataConfigs.from_dataset_card_data(data)
        infos = DatasetInfosDict.from_dataset_card_data(data)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise CardError(
            f"configs, dataset_info: expected what datasets reads, got {error}"
        ) from error
    if list(configs) != list(infos):
        raise CardError(f"dataset_info: expected configs {list(configs)}, got {list(infos)}")
    for name, info in infos.items():
        if not info.features:
            raise CardError(f"dataset_info, {name}: expected declared features, got none")
