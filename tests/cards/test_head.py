"""What the hub documents of a card's head is what is let through."""

from pathlib import Path

import pytest
from huggingface_hub import DatasetCard

from mint_hub.cards.head import check_head, size_category
from mint_hub.cards.sources import CardError

CARD = Path(__file__).parents[2] / "dataset_card/README.md"


@pytest.fixture
def head():
    return DatasetCard.load(CARD).data.to_dict()


def test_size_category():
    cases = {1: "n<1K", 999: "n<1K", 1000: "1K<n<10K", 560_649: "100K<n<1M", 10**7: "10M<n<100M"}
    assert {samples: size_category(samples) for samples in cases} == cases
    with pytest.raises(CardError, match="samples: expected fewer than 100,000,000"):
        size_category(10**8)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda h: h.update(license="free"), "license: expected one of .*, got 'free'"),
        (lambda h: h.pop("license_name"), "license_name: expected one beside license: other"),
        (lambda h: h.update(size_categories=["1M"]), "size_categories: expected one of"),
        (lambda h: h.update(annotations_creators="robots"), "annotations_creators: expected"),
        (lambda h: h.update(pretty_name=" "), "pretty_name: expected text, got ' '"),
        (lambda h: h.update(extra_gated_promt="x"), "extra_gated_promt: expected a key"),
        (lambda h: h["extra_gated_fields"].update(Age="number"), "Age: expected one of .*'text'"),
        (lambda h: h["extra_gated_fields"].update(A={"type": "select"}), "A: expected options"),
        (
            lambda h: h["extra_gated_fields"].update(A={"type": "text", "options": ["x"]}),
            "A: expected options for a select only",
        ),
        (lambda h: h.update(extra_gated_fields=["Name"]), "expected a type by field name"),
        (lambda h: h["configs"].pop(), "dataset_info: expected configs"),
        (lambda h: h["configs"][0].pop("config_name"), "expected what datasets reads"),
        (lambda h: h["configs"][0].update(data_files=3), "expected what datasets reads"),
        (lambda h: h["dataset_info"][0].pop("features"), "sample: expected declared features"),
        (
            lambda h: h["dataset_info"][0]["features"][1].update(dtype={"array9": {}}),
            "expected what datasets reads",
        ),
    ],
)
def test_errors_teach(head, change, message):
    check_head(head)
    change(head)
    with pytest.raises(CardError, match=message):
        check_head(head)
