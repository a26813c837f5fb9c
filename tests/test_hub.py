"""Round trips through a hub, and the code that a repository can carry.

Clients of the hub read their environment when they are imported, so every check below runs in one
of three subprocesses, against one loopback hub: "package" has mint_hub and the network, "offline"
has its caches but no network, "copied" has transformers but no mint_hub. A subprocess runs its
checks in the order of this file and reports each; a test here is one check.
"""

import copy
import json
import os
import subprocess
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.loopback_hub import OWNER_TOKEN, LoopbackHub

ROOT = Path(__file__).parent.parent
CHECKS: dict[str, dict[str, Callable[[Path], None]]] = {"package": {}, "offline": {}, "copied": {}}
OFFLINE = {"HF_HUB_OFFLINE": "1"}


def check(group: str) -> Callable[[Callable[[Path], None]], Callable[[Path], None]]:
    def add(function: Callable[[Path], None]) -> Callable[[Path], None]:
        CHECKS[group][function.__name__] = function
        return function

    return add


class Runner:
    """Runs a group of checks when first asked for; the package's group comes before the others."""

    def __init__(self, hub: LoopbackHub, folder: Path) -> None:
        self.hub, self.folder = hub, folder
        self.outcomes: dict[str, dict[str, str]] = {}

    def outcome(self, group: str, name: str) -> str:
        if not self.outcomes:
            self._run("package")
            self._run("offline", "copied")
        return self.outcomes[group][name]

    def _run(self, *groups: str) -> None:
        started = {group: self._start(group) for group in groups}
        for group, process in started.items():
            _, errors = process.communicate(timeout=300)
            report = self.folder / f"{group}.json"
            died = dict.fromkeys(CHECKS[group], f"the subprocess died\n{errors[-3000:]}")
            self.outcomes[group] = json.loads(report.read_text()) if report.is_file() else died

    def _start(self, group: str) -> subprocess.Popen[str]:
        home = self.folder / ("empty_home" if group == "copied" else "home")
        environment = os.environ | self.hub.environment(home, token=None)
        environment |= {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        environment |= OFFLINE if group == "offline" else {}
        environment.pop("HF_TOKEN", None)
        return subprocess.Popen(
            [sys.executable, __file__, group, str(self.folder)],
            cwd=self.folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )


@pytest.fixture(scope="module")
def runner(tmp_path_factory):
    with LoopbackHub() as hub:
        yield Runner(hub, tmp_path_factory.mktemp("hub"))


def outputs(model: Any) -> dict[str, Any]:
    """The model's outputs for fixed frames, by name.

    Of a copy: weights mapped from a file lie at other addresses than fresh ones, and matrix
    products answer with another last bit where the alignment differs.
    """
    import torch

    frames = torch.rand(1, 3, 3, 28, 42, generator=torch.Generator().manual_seed(7))
    with torch.no_grad():
        found = copy.deepcopy(model).eval()(frames)
    return {name: value for name, value in found.items() if isinstance(value, torch.Tensor)}


def same(one: dict[str, Any], two: dict[str, Any]) -> bool:
    """Whether outputs, or episodes as dictionaries, are equal to the last bit."""
    import numpy as np

    assert one.keys() == two.keys()
    for name, value in one.items():
        plain = isinstance(value, str | int | list | tuple | dict) or value is None
        equal = value == two[name] if plain else np.array_equal(value, two[name], equal_nan=True)
        if not equal:
            raise AssertionError(f"{name}: {value} != {two[name]}")
    return True


def episode_values(episode: Any) -> dict[str, Any]:
    """What was predicted, without the record of how."""
    names = ("T_camera_from_world", "hand_state", "presence", "presence_score", "fov_vh_rad")
    return {name: getattr(episode, name) for name in names}


def raises(kind: type[Exception], call: Callable[[], Any], *words: str) -> None:
    """Expect an error whose message has all the words."""
    with pytest.raises(kind) as caught:
        call()
    missing = [word for word in words if word not in str(caught.value)]
    assert not missing, f"{missing} not in: {caught.value}"


# --- with mint_hub and the network ----------------------------------------------------------------


@check("package")
def model_comes_back_from_a_folder_and_from_the_hub(here: Path) -> None:
    import torch

    from mint_hub import MintModel
    from tests.small_model import small_model

    model = small_model(seed=0)
    model.save_pretrained(here / "model")
    assert same(outputs(model), outputs(MintModel.from_pretrained(here / "model")))
    model.push_to_hub("org/model", token=OWNER_TOKEN)
    assert same(outputs(model), outputs(MintModel.from_pretrained("org/model")))
    torch.save(outputs(model), here / "seed0.pt")
    halved = MintModel.from_pretrained("org/model", dtype=torch.bfloat16)
    assert halved.dtype == torch.bfloat16


@check("package")
def a_revision_brings_its_own_weights(here: Path) -> None:
    import torch
    from huggingface_hub import HfApi

    from mint_hub import MintModel
    from tests.small_model import small_model

    api, older = HfApi(token=OWNER_TOKEN), torch.load(here / "seed0.pt")
    sha = api.model_info("org/model").sha
    api.create_tag("org/model", tag="v1")
    small_model(seed=1).push_to_hub("org/model", token=OWNER_TOKEN)
    small_model(seed=2).push_to_hub("org/model", revision="next", token=OWNER_TOKEN)
    for revision in (sha, "v1"):
        assert same(older, outputs(MintModel.from_pretrained("org/model", revision=revision)))
    for revision, seed in (("main", 1), ("next", 2)):
        newer = outputs(MintModel.from_pretrained("org/model", revision=revision))
        assert same(newer, outputs(small_model(seed=seed)))
    raises(OSError, lambda: MintModel.from_pretrained("org/model", revision="v9"), "v9")
    assert len(api.list_repo_commits("org/model")) == 3


@check("package")
def processors_come_back(here: Path) -> None:
    import numpy as np

    from mint_hub import MintProcessor, MintVideoProcessor
    from tests.small_model import small_config

    processor = MintProcessor.for_config(small_config())
    processor.video_processor.fps = 15.0
    frames = np.random.default_rng(0).integers(0, 256, (5, 50, 70, 3), np.uint8)
    expected = processor(frames, return_tensors="np")
    processor.save_pretrained(here / "processor")
    processor.push_to_hub("org/processor", token=OWNER_TOKEN)
    processor.video_processor.push_to_hub("org/video-processor", token=OWNER_TOKEN)
    found = [
        MintProcessor.from_pretrained(here / "processor"),
        MintProcessor.from_pretrained("org/processor"),
        MintVideoProcessor.from_pretrained("org/video-processor"),
    ]
    for one in found:
        assert same(dict(expected), dict(one(frames, return_tensors="np")))
        assert getattr(one, "video_processor", one).fps == 15.0


@check("package")
def pipeline_comes_back(here: Path) -> None:
    from huggingface_hub import HfApi
    from transformers import pipeline

    from tests.small_model import small_model
    from tests.video_files import video

    clip = str(video(here / "clip.mp4", 40))
    pipe = pipeline("egocentric-hands", model=small_model(), devices=["cpu"])
    expected = episode_values(pipe(clip))
    pipe.save_pretrained(here / "pipeline")
    pipe.push_to_hub("org/pipeline", token=OWNER_TOKEN)
    for source in (str(here / "pipeline"), "org/pipeline"):
        found = pipeline("egocentric-hands", model=source, devices=["cpu"])(clip)
        assert same(expected, episode_values(found))
        assert found.meta["provenance"]["model"] == source
    sha = HfApi().model_info("org/pipeline").sha
    assert found.meta["provenance"]["revision"] == sha


@check("package")
def a_private_repository_needs_its_token(here: Path) -> None:
    from transformers import pipeline

    from mint_hub import MintModel, MintProcessor
    from tests.small_model import small_model

    name = "org/private"
    raises(Exception, lambda: small_model().push_to_hub(name), "401")
    pipe = pipeline("egocentric-hands", model=small_model())
    pipe.push_to_hub(name, private=True, token=OWNER_TOKEN)
    raises(OSError, lambda: MintModel.from_pretrained(name), name, "token")
    raises(OSError, lambda: MintModel.from_pretrained(name, token="hf_wrong"), name)
    raises(OSError, lambda: MintProcessor.from_pretrained(name), name)
    raises(OSError, lambda: pipeline("egocentric-hands", model=name), name)
    model = MintModel.from_pretrained(name, token=OWNER_TOKEN)
    assert same(outputs(model), outputs(small_model()))
    assert pipeline("egocentric-hands", model=name, token=OWNER_TOKEN).processor is not None


@check("package")
def caches_are_where_they_are_asked_for(here: Path) -> None:
    from mint_hub import MintModel, MintProcessor

    elsewhere = here / "elsewhere"
    MintModel.from_pretrained("org/pipeline", cache_dir=elsewhere)
    MintProcessor.from_pretrained("org/pipeline", cache_dir=elsewhere)
    assert list(elsewhere.glob("models--org--pipeline/snapshots/*/model.safetensors"))
    for cls, words in ((MintModel, ("org/pipeline", "cache")), (MintProcessor, ("org/pipeline",))):
        cls.from_pretrained("org/pipeline", cache_dir=elsewhere, local_files_only=True)
        options = {"cache_dir": here / "empty", "local_files_only": True}
        raises(
            OSError,
            lambda cls=cls, options=options: cls.from_pretrained("org/pipeline", **options),
            *words,
        )


@check("package")
def auto_classes_find_ours(here: Path) -> None:
    from transformers import AutoConfig, AutoModel, AutoProcessor
    from transformers.models.auto.video_processing_auto import AutoVideoProcessor

    import mint_hub

    for auto, name in (
        (AutoConfig, "MintConfig"),
        (AutoModel, "MintModel"),
        (AutoProcessor, "MintProcessor"),
        (AutoVideoProcessor, "MintVideoProcessor"),
    ):
        assert type(auto.from_pretrained("org/pipeline")) is getattr(mint_hub, name), name
    found = AutoVideoProcessor.from_pretrained("org/video-processor")
    assert type(found) is mint_hub.MintVideoProcessor


@check("package")
def a_release_repository_loads_under_its_own_names(here: Path) -> None:
    from huggingface_hub import HfApi

    from mint_hub import MintModel
    from tests.model.golden import golden_config, release_folder

    golden, api = ROOT / "tests" / "golden", HfApi(token=OWNER_TOKEN)
    config = golden_config(golden)
    for name, with_config in (("with-config", True), ("without-config", False)):
        folder = release_folder(golden, here / name, with_config)
        api.create_repo(f"org/{name}")
        api.upload_folder(repo_id=f"org/{name}", folder_path=folder)
    expected = MintModel.from_pretrained(here / "with-config").state_dict()
    for model in (
        MintModel.from_pretrained("org/with-config"),
        MintModel.from_pretrained("org/without-config", config=config),
    ):
        assert same(expected, model.state_dict())
    raises(ValueError, lambda: MintModel.from_pretrained("org/without-config"), "config=")


@check("package")
def code_travels_only_when_asked_for(here: Path) -> None:
    import torch
    from huggingface_hub import HfApi
    from transformers import pipeline

    from mint_hub import MintModel
    from tests.small_model import small_model

    api = HfApi()
    assert not [f for f in api.list_repo_files("org/pipeline") if f.endswith(".py")]
    pipe = pipeline("egocentric-hands", model=small_model())
    pipe.push_to_hub("org/coded", remote_code=True, token=OWNER_TOKEN)
    small_model().push_to_hub("org/coded-model", remote_code=True, token=OWNER_TOKEN)
    pipe.processor.push_to_hub("org/coded-processor", remote_code=True, token=OWNER_TOKEN)
    pipe.processor.video_processor.push_to_hub(
        "org/coded-video-processor", remote_code=True, token=OWNER_TOKEN
    )
    pipe.save_pretrained(here / "coded", remote_code=True)
    assert {"modeling_mint.py", "pipeline_mint.py"} <= set(api.list_repo_files("org/coded"))
    assert len(api.list_repo_commits("org/coded")) == 2  # the code comes in the same commit
    raises(
        ValueError,
        lambda: MintModel.save_pretrained(
            small_model(), here / "early", remote_code=True, push_to_hub=True
        ),
        "push_to_hub(repo, remote_code=True)",
    )
    torch.save(outputs(small_model()), here / "coded.pt")


@check("package")
def where_mint_hub_is_imported_its_own_classes_are_used(here: Path) -> None:
    from transformers import AutoModel, AutoProcessor, pipeline

    import mint_hub
    from mint_hub.inference.pipeline_mint import EgocentricHandsPipeline

    for trust in (None, False, True):
        pipe = pipeline("egocentric-hands", model="org/coded", trust_remote_code=trust)
        assert type(pipe) is EgocentricHandsPipeline
        model = AutoModel.from_pretrained("org/coded", trust_remote_code=trust)
        assert type(model) is mint_hub.MintModel
        processor = AutoProcessor.from_pretrained("org/coded", trust_remote_code=trust)
        assert type(processor) is mint_hub.MintProcessor
        assert type(processor.video_processor) is mint_hub.MintVideoProcessor
    assert not any(name.startswith("transformers_modules") for name in sys.modules)
    pipe.save_pretrained(here / "again")
    for file in (here / "again").glob("*.json"):
        text = file.read_text()
        assert "auto_map" not in text, file
        assert "custom_pipelines" not in text, file
    pipe(str(here / "clip.mp4"), presence_threshold=-0.5).save(here / "coded.npz")


@check("package")
def package_and_copy_live_in_one_process(here: Path) -> None:
    import torch
    from transformers.dynamic_module_utils import get_class_from_dynamic_module

    from mint_hub import MintModel

    copied = get_class_from_dynamic_module("modeling_mint.MintModel", "org/coded")
    assert copied is not MintModel
    expected = torch.load(here / "coded.pt")
    assert same(expected, outputs(copied.from_pretrained("org/coded")))
    assert same(expected, outputs(MintModel.from_pretrained("org/coded")))


# --- with the caches of the above, without the network --------------------------------------------


@check("offline")
def caches_are_enough(here: Path) -> None:
    import torch
    from transformers import AutoProcessor, pipeline

    from mint_hub import MintModel
    from tests.model.golden import golden_config

    older = torch.load(here / "seed0.pt")
    assert same(older, outputs(MintModel.from_pretrained("org/model", revision="v1")))
    newer = outputs(MintModel.from_pretrained("org/model"))
    assert not torch.equal(newer["hand_state"], older["hand_state"])
    assert AutoProcessor.from_pretrained("org/processor").video_processor.fps == 15.0
    episode = pipeline("egocentric-hands", model="org/pipeline")(str(here / "clip.mp4"))
    assert episode.num_frames == 40
    config = golden_config(ROOT / "tests" / "golden")
    MintModel.from_pretrained("org/without-config", config=config)


@check("offline")
def what_is_not_cached_is_named(here: Path) -> None:
    from transformers import AutoModel, pipeline

    from mint_hub import MintModel, MintProcessor

    raises(OSError, lambda: MintModel.from_pretrained("org/unseen"), "org/unseen", "HF_HUB_OFFLINE")
    raises(OSError, lambda: MintProcessor.from_pretrained("org/unseen"), "org/unseen")
    for load in (
        AutoModel.from_pretrained,
        lambda name: pipeline("egocentric-hands", model=name),
    ):
        raises(OSError, lambda load=load: load("org/unseen"), "offline mode", "cached files")


# --- without mint_hub: only what the repository carries -------------------------------------------


@check("copied")
def copied_model_is_equal(here: Path) -> None:
    import torch
    from transformers import AutoConfig, AutoModel

    expected = torch.load(here / "coded.pt")
    for source in ("org/coded", "org/coded-model", here / "coded"):
        model = AutoModel.from_pretrained(source, trust_remote_code=True)
        assert type(model).__module__.startswith("transformers_modules.")
        assert same(expected, outputs(model))
    config = AutoConfig.from_pretrained("org/coded", trust_remote_code=True)
    assert config.grid_hw == (2, 3)
    raises(
        ValueError,
        lambda: AutoModel.from_pretrained("org/coded", trust_remote_code=False),
        "trust_remote_code=True",
    )
    raises(ValueError, lambda: AutoModel.from_pretrained("org/pipeline"), "mint")


@check("copied")
def copied_processors_are_equal(here: Path) -> None:
    import numpy as np
    from transformers import AutoProcessor
    from transformers.models.auto.video_processing_auto import AutoVideoProcessor

    frames = np.random.default_rng(0).integers(0, 256, (5, 28, 42, 3), np.uint8)
    for auto, source in (
        (AutoProcessor, "org/coded"),
        (AutoProcessor, "org/coded-processor"),
        (AutoVideoProcessor, "org/coded"),
        (AutoVideoProcessor, "org/coded-video-processor"),
    ):
        processor = auto.from_pretrained(source, trust_remote_code=True)
        pixels = processor(frames, return_tensors="np")["pixel_values"]
        np.testing.assert_allclose(pixels[0], frames.transpose(0, 3, 1, 2) / 255, atol=1e-6)
    assert processor(str(here / "clip.mp4"))["pixel_values"][0].shape == (40, 3, 28, 42)


@check("copied")
def copied_pipeline_gives_the_same_episode(here: Path) -> None:
    from transformers import pipeline

    pipe = pipeline("egocentric-hands", model="org/coded", trust_remote_code=True)
    episode = pipe(str(here / "clip.mp4"), presence_threshold=-0.5)
    expected = type(episode).load(here / "coded.npz")
    assert episode.presence.any()
    assert same(episode.to_dict(), expected.to_dict())
    assert episode.joints_camera().shape == (40, 2, 21, 3)  # the hand asset came along
    folder = pipeline("egocentric-hands", model=str(here / "coded"), trust_remote_code=True)
    again = folder(str(here / "clip.mp4"), presence_threshold=-0.5)
    assert same({"hand_state": again.hand_state}, {"hand_state": expected.hand_state})
    raises(
        ValueError,
        lambda: pipeline("egocentric-hands", model="org/coded", trust_remote_code=False),
        "trust_remote_code=True",
    )


@check("copied")
def a_copy_can_be_saved_with_its_code_again(here: Path) -> None:
    from transformers import pipeline

    pipe = pipeline("egocentric-hands", model="org/coded", trust_remote_code=True)
    pipe.save_pretrained(here / "second", remote_code=True)
    second = pipeline("egocentric-hands", model=str(here / "second"), trust_remote_code=True)
    episode = second(str(here / "clip.mp4"), presence_threshold=-0.5)
    expected = type(episode).load(here / "coded.npz")
    assert same({"hand_state": episode.hand_state}, {"hand_state": expected.hand_state})
    assert not any(name.split(".")[0] == "mint_hub" for name in sys.modules)


# --- the tests ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("group", "name"), [(group, name) for group, names in CHECKS.items() for name in names]
)
def test_hub(runner, group, name):
    outcome = runner.outcome(group, name)
    assert outcome == "", outcome


class _NoMintHub:
    """An import finder that hides mint_hub."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> None:
        if name.split(".")[0] == "mint_hub":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def main(group: str, here: Path) -> None:
    if group == "copied":
        sys.meta_path.insert(0, _NoMintHub())
    else:
        import mint_hub  # noqa: F401
    outcomes = {}
    for name, function in CHECKS[group].items():
        try:
            function(here)
        except (Exception, pytest.fail.Exception):
            outcomes[name] = traceback.format_exc()
        else:
            outcomes[name] = ""
    (here / f"{group}.json").write_text(json.dumps(outcomes))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
