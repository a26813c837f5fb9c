"""A run of training from a request: data, network, trainer; made again, it goes on.

    report = train(Request(recipe=recipe_named("stage1"), data=("corpus",), out="run", pace=...))

``run.json`` in the run's folder says what the run is. The same request goes on from the newest
checkpoint; another one is refused. At the end the network lies in ``model``.
"""

from __future__ import annotations

import copy
import json
import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import torch
from transformers.trainer_utils import set_seed

from mint_hub._version import __version__
from mint_hub.assets import checkpoint_named
from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.resolvers import Videos
from mint_hub.model.configuration_mint import MintConfig
from mint_hub.model.modeling_mint import MintModel
from mint_hub.model.processing_mint import MintProcessor
from mint_hub.synth.teacher_noise import TeacherNoise
from mint_hub.training.augment import Augmentation, ColourAugmentation
from mint_hub.training.clips import DataError, find_splits
from mint_hub.training.data import PositionDataset, TrainingWindows, WindowSettings, open_windows
from mint_hub.training.recipes import Recipe
from mint_hub.training.trainer import (
    LOG,
    STAGING,
    MintTrainer,
    Pace,
    compile_layers,
    last_checkpoint,
    training_arguments,
)
from mint_hub.training.views import ViewAugmentation

__all__ = ["CARD_HEAD", "MODEL", "RUN", "Report", "Request", "first_line", "read_log", "train"]

RUN: Final = "run.json"
MODEL: Final = "model"
SURVEYS: Final = "surveys"
LEFT_OUT: Final = (
    "the network began with a camera refinement by pictures, which is left out: stage 1 learns its "
    "own path; stage2+refine puts a new one there"
)
CARD_HEAD: Final = "---\nlibrary_name: transformers\ntags:\n- mint\n- egocentric\n- hands\n---\n"


@dataclass(frozen=True)
class Request:
    """What to train.

    Attributes:
        recipe: of this stage.
        data: corpus folders, their configs, or splits.
        out: folder of the run.
        pace: length of the run, and how often what is written.
        init: "random"; a LingBot-Map checkpoint (.pt); a folder or repository of a MINT model; or
            "mint-tiny", the embedded one.
        config: sizes of the network; needed with "random" and .pt, checked with a model.
        validation: corpus folders to score on during training; None: the validation splits of
            ``data``, where the pace asks for scores.
        mixture: weights of sources by name; None: each window alike.
        cap_per_stratum: most windows of a (source, domain, participant).
        noise: corrupt the training labels as a cascade would, see `synth.teacher_noise`.
        videos: where videos of unpacked corpora are.
        allow_evaluation_clips: train on clips that are kept for evaluation.
        augment: colours; None: as the recipe says.
        command: what was typed, for the record.
        cpu: train on the CPU even where there is a GPU.
        progress: show a bar.
        fsdp: shard the network's layers over processes (FSDP2) instead of copying it to each.
        cache: folder for surveys and decoded pictures, shared by runs on the same data; None:
            surveys lie in ``out``, pictures are decoded whenever they are read.
        attention: implementation, "sdpa" or "eager" (faster on a CPU where windows are short).
        compile: compile the network's layers (torch.compile; on a CPU it needs a C++ compiler).

    """

    recipe: Recipe
    data: Sequence[str | Path]
    out: str | Path
    pace: Pace
    init: str = "random"
    config: MintConfig | None = None
    validation: Sequence[str | Path] | None = None
    mixture: Mapping[str, float] | None = None
    cap_per_stratum: int | None = None
    noise: TeacherNoise | None = None
    videos: Videos | None = None
    allow_evaluation_clips: bool = False
    augment: Augmentation | None = None
    command: str = ""
    cpu: bool = False
    progress: bool = False
    fsdp: bool = False
    cache: Path | None = None
    attention: str = "sdpa"
    compile: bool = False


@dataclass(frozen=True)
class Report:
    """What became of a run.

    Attributes:
        model: folder of the trained network.
        steps: done in all.
        resumed_from: step of the checkpoint that it went on from; 0: from the beginning.
        log: the lines of the log.
        warnings: what was left out of the data or the network, in words.

    """

    model: Path
    steps: int
    resumed_from: int
    log: list[dict[str, Any]]
    warnings: tuple[str, ...]


def train(request: Request) -> Report:
    """Train, or go on training.

    Raises:
        DataError: nothing that may be trained on; see `data.open_windows`.
        ValueError: a request that contradicts itself, its recipe, or the run that lies there; a
            checkpoint of another size.
        OSError: a checkpoint that cannot be written; nothing is left half-written.
        RuntimeError: a loss that is not finite.

    """
    out = Path(request.out).absolute()
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out}: expected a folder for the run, found a file")
    _check(request)
    world = int(os.environ.get("WORLD_SIZE", "1"))
    checkpoint = last_checkpoint(out)
    # Before the model: it makes the process group, so that ranks agree on devices and seeds.
    arguments = training_arguments(
        out,
        request.recipe,
        request.pace,
        world_size=world,
        cpu=request.cpu,
        progress=request.progress,
        **({"fsdp": True, "fsdp_config": {"version": 2}} if request.fsdp else {}),
    )
    config = _config(request, checkpoint)
    windows = _windows(request, config, out)
    _check_windows(request, config, windows)
    facts = _facts(request, config, windows)
    _check_run(out, facts)
    validation = _validation(request, windows, out)
    done = out / MODEL
    if done.is_dir() and checkpoint is not None and _step(checkpoint) >= request.pace.steps:
        return Report(done, _step(checkpoint), _step(checkpoint), read_log(out), windows.warnings)
    set_seed(request.recipe.optimisation.seed)
    notes = list(windows.warnings)
    if checkpoint is not None:
        model = MintModel(config)
    else:
        begun = _sizes(request)
        model = _model(request, begun, config)
        if begun.camera_refinement == "pictures" and config.camera_refinement == "none":
            notes.append(LEFT_OUT)
    with arguments.main_process_first(desc="run.json"):  # from here on it is a run
        if arguments.process_index == 0:
            _record(out, facts, request.command)
            shutil.rmtree(out / STAGING, ignore_errors=True)
    model.set_attn_implementation(request.attention)
    if request.compile:
        compile_layers(model)
    if request.cache is not None:
        with arguments.main_process_first(desc="pictures"):
            windows = windows.cached(request.cache, request.recipe.views, request.progress)
    trainer = MintTrainer(
        model,
        request.recipe,
        request.pace,
        arguments,
        PositionDataset(
            windows,
            request.pace.steps * request.recipe.batch,
            _augmentation(request),
            ViewAugmentation() if request.recipe.views else None,
        ),
        validation,
        _Card(request, facts),
    )
    trainer.train(resume_from_checkpoint=None if checkpoint is None else str(checkpoint))
    if request.pace.steps % request.pace.save_every:
        trainer.save_now()
    trainer.save_folder(done)
    return Report(
        done,
        trainer.state.global_step,
        0 if checkpoint is None else _step(checkpoint),
        list(trainer.state.log_history),
        tuple(notes),
    )


# --- parts ----------------------------------------------------------------------------------------


def _check(request: Request) -> None:
    recipe, random = request.recipe, request.init == "random"
    if recipe.stage == 2 and (random or request.init.endswith(".pt")):
        raise ValueError(
            f"recipe {recipe.name}: stage 2 trains the camera head of a stage 1 network: expected "
            f"its folder or repository as --init, got {request.init!r}"
        )
    if recipe.stage == 2 and request.noise is not None:
        raise ValueError(
            f"recipe {recipe.name}: stage 2 learns from exact cameras: expected no teacher noise"
        )
    if request.validation and request.pace.evaluate_every is None:
        raise ValueError("validation: expected with evaluate_every, which says when, got it alone")
    if recipe.init == "random" and not random:
        raise ValueError(f"recipe {recipe.name}: expected --init random, got {request.init!r}")
    if recipe.init == "pretrained" and random:
        raise ValueError(f"recipe {recipe.name}: expected a checkpoint as --init, got random")
    if recipe.optimisation.warmup_steps >= request.pace.steps:
        raise ValueError(
            f"steps: expected more than the {recipe.optimisation.warmup_steps} steps of warm-up, "
            f"got {request.pace.steps}"
        )


def _config(request: Request, checkpoint: Path | None) -> MintConfig:
    """Of the network that is trained; of one that lies there, if the request does not say."""
    if checkpoint is not None and request.config is None:
        config = MintConfig.from_pretrained(checkpoint)
    else:
        config = copy.deepcopy(_sizes(request))
    config.window = request.recipe.window
    if request.recipe.refine:
        config.camera_refinement = "pictures"
        config.validate_architecture()
    elif request.recipe.stage == 1:  # which learns the network's own path
        config.camera_refinement = "none"
    return config


def _sizes(request: Request) -> MintConfig:
    """Of the network that it begins with, without its weights."""
    if request.init == "random" or request.init.endswith(".pt"):
        if request.init != "random" and not Path(request.init).is_file():
            raise ValueError(f"--init {request.init}: no such file")
        return request.config or MintConfig.full()
    if request.init.startswith((".", "/", "~")) and not Path(request.init).is_dir():
        raise ValueError(f"--init {request.init}: no such folder")
    if request.config is not None:
        return request.config
    name = checkpoint_named(request.init)
    if Path(name).is_dir() and not Path(name, "config.json").is_file():
        return MintConfig.full()  # of the public release; from_pretrained checks its shapes
    return MintConfig.from_pretrained(name)


def _model(request: Request, begun: MintConfig, config: MintConfig) -> MintModel:
    if request.init == "random":
        return MintModel(config)
    if request.init.endswith(".pt"):
        return MintModel.from_lingbot_map(request.init, config)
    given = copy.deepcopy(config)
    given.camera_refinement = begun.camera_refinement  # as its weights are
    model = MintModel.from_pretrained(
        checkpoint_named(request.init), config=given, dtype=torch.float32
    )
    if config.camera_refinement == "pictures":
        model.refine_by_pictures()
    else:
        model.leave_path_unrefined()
    return model


def _settings(request: Request) -> WindowSettings:
    recipe = request.recipe
    return WindowSettings(
        length=recipe.window,
        stride=recipe.stride,
        presence=recipe.presence,
        cap_per_stratum=request.cap_per_stratum,
        mixture=request.mixture,
        seed=recipe.optimisation.seed,
        videos=request.videos,
        allow_evaluation_clips=request.allow_evaluation_clips,
    )


def _windows(request: Request, config: MintConfig, out: Path) -> TrainingWindows:
    splits = find_splits(request.data, "train", request.noise, request.recipe.optimisation.seed)
    processor = MintProcessor.for_config(config)
    windows = open_windows(splits, _settings(request), processor, _surveys(request, out))
    windows.order()  # a mixture that names no source of these is refused now
    return windows


def _surveys(request: Request, out: Path) -> Path:
    return out / SURVEYS if request.cache is None else request.cache


def _check_windows(request: Request, config: MintConfig, windows: TrainingWindows) -> None:
    if request.recipe.sources == "one" and len(windows.sources) > 1:
        raise DataError(
            f"recipe {request.recipe.name}: expected data of one source, got "
            f"{', '.join(windows.sources)}"
        )
    others = [space for space in windows.shape_spaces if space not in ("", config.shape_space)]
    if others and "hand_head" in request.recipe.trained:
        raise DataError(
            f"shape numbers: expected those of the network's space, {config.shape_space!r}, got "
            f"{others[0]!r}; make the network with that shape_space, or train on other data"
        )


def _augmentation(request: Request) -> Augmentation | None:
    if request.augment is not None:
        return request.augment
    return ColourAugmentation() if request.recipe.augment else None


def _validation(request: Request, windows: TrainingWindows, out: Path) -> TrainingWindows | None:
    """Windows to score on, with exact labels, in the training's scales; clips of benches may be."""
    if request.pace.evaluate_every is None:
        return None
    settings = WindowSettings(
        length=request.recipe.window,
        stride=request.recipe.window,
        presence=request.recipe.presence,
        videos=request.videos,
        allow_evaluation_clips=True,
    )
    splits = find_splits(request.validation or request.data, "validation")
    kept = _surveys(request, out)
    return open_windows(splits, settings, windows.processor, kept, windows.scales)


# --- the record -----------------------------------------------------------------------------------


def _facts(request: Request, config: MintConfig, windows: TrainingWindows) -> dict[str, Any]:
    """What makes a run the same run, ready for JSON."""
    recipe = request.recipe
    sizes = {k: v for k, v in config.to_dict().items() if k in MintConfig.__annotations__}
    facts = {
        "recipe": recipe.name,
        "stage": recipe.stage,
        "loss": dict(recipe.loss.weights),
        "observability": recipe.loss.observability,
        "learning_rates": dict(recipe.learning_rates),
        "batch": recipe.batch,
        "window": recipe.window,
        "stride": recipe.stride,
        "presence": recipe.presence,
        "refine": recipe.refine,
        "optimisation": asdict(recipe.optimisation),
        "steps": request.pace.steps,
        "init": request.init,
        "config": sizes,
        "data": windows.content,
        "sources": dict(zip(windows.sources, windows.sizes, strict=True)),
        "mixture": None if request.mixture is None else dict(request.mixture),
        "augmentation": repr(_augmentation(request)),
        "views": repr(ViewAugmentation()) if recipe.views else None,
        "noise": None if request.noise is None else asdict(request.noise),
    }
    return json.loads(json.dumps(facts))


def _record(out: Path, facts: dict[str, Any], command: str) -> None:
    """Write what a new run is, and what began it."""
    if not (out / RUN).is_file():
        with replacing(out / RUN) as temporary:
            temporary.write_text(json.dumps({**facts, "command": command}, indent=1) + "\n")


def _check_run(out: Path, facts: dict[str, Any]) -> None:
    """Refuse another run's folder."""
    path = out / RUN
    if not path.is_file():
        if last_checkpoint(out) is not None:
            raise ValueError(f"{out}: has checkpoints but no {RUN}: choose another folder")
        return
    try:
        before = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path}: damaged: {error}") from error
    for name, value in facts.items():
        if before.get(name) != value:
            raise ValueError(
                f"{out}: another run lies here: {name} was {before.get(name)!r}, now {value!r}. "
                "Choose another folder, or the same options to go on"
            )


def first_line(sources: Iterable[str]) -> str:
    """Say on a card what a network trained on these sources is."""
    if all("mint-hub synth" in name for name in sources):
        return "Trained on synthetic clips only, for trying the API, not for labelling."
    return "A checkpoint of a training run; evaluate it before use."


def _step(checkpoint: Path) -> int:
    return int(checkpoint.name.rsplit("-", 1)[1])


def read_log(out: Path) -> list[dict[str, Any]]:
    """Read the lines of a run's log; none where there is no log yet."""
    path = out / LOG
    return [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []


@dataclass(frozen=True)
class _Card:
    """README.md of a checkpoint."""

    request: Request
    facts: Mapping[str, Any]

    def __call__(self, now: Mapping[str, Any]) -> str:
        facts = self.facts
        sources = ", ".join(f"{name or 'unnamed'} ({n})" for name, n in facts["sources"].items())
        rows = {
            "recipe": facts["recipe"],
            "begun with": facts["init"] if facts["init"] == "random" else "a checkpoint",
            "steps": f"{now['steps']} of {facts['steps']}",
            "frames seen": f"{now['frames']:,}",
            "windows": f"{sources}, data hash {facts['data']}",
            "seed": facts["optimisation"]["seed"],
            "mint-hub": __version__,
            "command": f"`{self.request.command}`" if self.request.command else "the Python API",
        }
        table = "\n".join(f"| {name} | {value} |" for name, value in rows.items())
        return f"{CARD_HEAD}\n{first_line(facts['sources'])}\n\n| | |\n| --- | --- |\n{table}\n"
