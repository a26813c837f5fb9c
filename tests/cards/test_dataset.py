"""The card of mint-ego is a fresh rendering, says its limits first, and the hub's tools read it."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from string import Template

import pytest
from huggingface_hub import DatasetCard

from mint_hub.assets import asset_path
from mint_hub.cards.dataset import TEMPLATE, card_configs, card_head, render
from mint_hub.cards.head import check_head
from mint_hub.cards.sources import CardError, Sources
from mint_hub.loaders.changelog import CHANGELOG
from mint_hub.loaders.derived import VIDEO_MEMBER, card_data, schema_table
from mint_hub.loaders.location import CONFIGS, PARTS
from mint_hub.loaders.manifest import read_manifest
from mint_hub.loaders.shards import write_corpus
from mint_hub.loaders.tar_layout import CorpusError
from mint_hub.loaders.withdraw import withdraw
from tests.episodes import make_episode

FOLDER = Path(__file__).parents[2] / "dataset_card"
CARD = FOLDER / "README.md"
SAMPLE = read_manifest(asset_path("sample_corpus") / "sample/train")


@pytest.fixture
def folder(tmp_path):
    return shutil.copytree(FOLDER, tmp_path / "checkout/dataset_card")


def command(checkout):
    call = [sys.executable, "-m", "mint_hub.cards", str(checkout)]
    return subprocess.run(call, capture_output=True, text=True, check=False, cwd=FOLDER.parent)


def test_committed_card_is_a_fresh_rendering():
    assert CARD.read_text(encoding="utf-8") == render(FOLDER), "run: python -m mint_hub.cards"


def test_command_renders_it(folder):
    (folder / "README.md").write_text("stale")
    done = command(folder.parent)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert (folder / "README.md").read_bytes() == CARD.read_bytes()


def test_command_ends_with_one_line_where_a_source_is_wrong(folder):
    (folder / "sources.json").unlink()
    done = command(folder.parent)
    assert done.returncode == 1
    assert done.stderr.endswith("sources.json: expected this file, got none\n")
    assert done.stderr.count("\n") == 1


def test_hub_loads_it_and_writes_the_same():
    card = DatasetCard.load(CARD)
    assert str(card) == CARD.read_text(encoding="utf-8")
    assert card.data.to_dict() == card_head(Sources.load(FOLDER), [SAMPLE])
    check_head(card.data.to_dict())
    assert {c["config_name"] for c in card.data["configs"]} == set(CONFIGS)
    assert card.data["size_categories"] == ["100K<n<1M"]


def test_form_asks_for_the_terms_of_every_source():
    form = DatasetCard.load(CARD).data["extra_gated_fields"]
    for source in Sources.load(FOLDER).sources:
        assert form[source.name]["type"] == "select"
        assert source.agreement in form[source.name]["options"]
    assert "checkbox" in form.values()


def test_stock_datasets_reads_a_folder_with_this_card(tmp_path):
    """As it will lie on the hub: the sample by default, each source, and all of them as one."""
    import datasets

    corpus = shutil.copytree(asset_path("sample_corpus"), tmp_path / "corpus")
    for number, config in enumerate(PARTS):
        made = [make_episode(12, seed=i, key=f"{config}-{i}") for i in range(number + 1)]
        write_corpus(made, corpus, config, "train")
        write_corpus(made[:1], corpus, config, "validation")
    shutil.copyfile(CARD, corpus / "README.md")
    cache = str(tmp_path / "cache")
    assert datasets.load_dataset(str(corpus), cache_dir=cache)["train"].num_rows == 3
    table = datasets.load_dataset(str(corpus), "all", cache_dir=cache)
    assert {name: part.num_rows for name, part in table.items()} == {"train": 6, "validation": 3}
    egodex = datasets.load_dataset(str(corpus), "egodex", split="train", cache_dir=cache)
    assert set(egodex["__key__"]) == {"egodex-0", "egodex-1", "egodex-2"}
    assert egodex.with_format("numpy")[0]["traj.npy"].shape == (12, 17)


def test_limits_come_first():
    text = DatasetCard.load(CARD).text
    screen = text[: text.index("## Sources")]
    assert text.index("## Limits") == text.index("## ")
    for words in (
        "Pseudo-labels",
        "scale-enlarged",
        "metric ground truth",
        "No video",
        "Trained-on",
    ):
        assert words in screen
    assert len(screen.split()) < 350, "the limits no longer fit the first screen"


def test_numbers_are_of_the_files_and_of_the_release():
    text = CARD.read_text(encoding="utf-8")
    release = Sources.load(FOLDER).release
    assert f"| {release.hours:,.1f} | {release.episodes:,} | {release.frames:,} |" in text
    assert f"| {SAMPLE.num_episodes:,} | {SAMPLE.num_frames:,} | us, from the files |" in text
    for part in ("members", "json", "episode"):
        assert schema_table(part) in text
    assert "lawyer" in text
    assert "CC BY-NC-ND" in text


def test_template_uses_all_that_is_made(folder):
    names = Template((FOLDER / TEMPLATE).read_text(encoding="utf-8")).get_identifiers()
    (folder / TEMPLATE).write_text("$nothing")
    with pytest.raises(
        CardError, match=r"template\.md: expected \$names of .*, got 'nothing'"
    ) as e:
        render(folder)
    for name in names:
        assert f"'{name}'" in str(e.value)
    assert str(e.value).count("', '") + 1 == len(names)


def test_every_source_changes_the_card(folder):
    before = render(folder)
    sources = json.loads((folder / "sources.json").read_text())
    sources["sources"][2]["unknown"].append("Something new.")
    (folder / "sources.json").write_text(json.dumps(sources))
    changed = render(folder)
    assert "- EgoDex: Something new.\n" in changed
    assert before not in (changed, render(folder))
    (folder / TEMPLATE).write_text("words only")
    assert render(folder).endswith("---\nwords only")


def test_changelog_of_a_corpus_is_the_changelog_of_its_card(folder, tmp_path):
    made = [
        make_episode(12, seed=i, key=f"e-{i}", meta={"uid": f"v{i}", "source": "ego4d"})
        for i in range(2)
    ]
    write_corpus(made, tmp_path / "corpus", "ego4d", "train")
    withdraw(tmp_path / "corpus", ["v1"], "taken back", date="2026-01-31")
    shutil.copyfile(tmp_path / "corpus" / CHANGELOG, folder / CHANGELOG)
    row = "| 2026-01-31 | ego4d | v1 | ego4d/train: 1 | taken back |"
    assert row in render(folder)
    assert row in (tmp_path / "corpus/README.md").read_text()
    (folder / CHANGELOG).write_text("{}")
    with pytest.raises(CorpusError, match=r"changelog\.json: expected an object"):
        render(folder)


def test_configs_are_those_that_are_published():
    configs = card_configs([SAMPLE])
    assert tuple(config.name for config in configs) == CONFIGS
    assert [config.name for config in configs if config.default] == ["sample"]
    data = card_data(configs)
    by_name = {entry["config_name"]: entry for entry in data["configs"]}
    assert by_name["all"]["data_files"][0]["path"] == [f"{part}/train/*.tar" for part in PARTS]
    packed = {
        info["config_name"]
        for info in data["dataset_info"]
        if VIDEO_MEMBER in {f["name"] for f in info["features"]}
    }
    assert packed == {"sample"}, "no video may be published but our own drawing"
