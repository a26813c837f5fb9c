"""The verb of the command line that trains."""

import argparse
import os
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mint_hub.model.configuration_mint import MintConfig
    from mint_hub.training.recipes import Recipe


def add_train(commands: Any) -> None:
    """Add `mint-hub train`."""
    parser = commands.add_parser(
        "train",
        help="train a network on corpora with pictures",
        description="Train on packed corpora, or on labels beside your videos. RECIPE is stage1, "
        "stage2, paper-stage1 or paper-stage2, then options: +world, "
        "+no-world, +motion, +guide, +no-image, +random, +pretrained, +one-source, +visible, "
        "+augment, +views, +refine, +even, +scratch, +fp32. Interrupted, the same command goes on "
        "from the newest checkpoint. Several GPUs: start it with torchrun or "
        "accelerate. Clips that benchmarks score on are refused. Needs mint-hub[train].",
    )
    add = parser.add_argument
    add("--recipe", required=True, help="stage1, stage2, or a name with +options")
    add("--data", nargs="+", required=True, metavar="DIR", help="corpora, configs or splits")
    add(
        "--init", required=True, help="random, lingbot-map.pt, a folder or repository, or mint-tiny"
    )
    add("-o", "--out", type=Path, required=True, help="folder of the run; the network: OUT/model")
    add("--config", help="tiny, full, or a folder with config.json (default: the checkpoint's)")
    add("--steps", type=int, required=True, help="steps of the whole run")
    add("--batch", type=int, help="windows a step, all processes together (default: the recipe's)")
    add("--micro-batch", type=int, help="windows at once in a process (default: all of its share)")
    add("--window", type=int, help="frames of a window, and its stride (default: the recipe's)")
    add("--stride", type=int, help="frames from one window to the next (default: the window)")
    add("--warmup", type=int, help="default: the recipe's, at most a tenth of the steps")
    add("--lr-factor", type=float, default=1.0, help="on all learning rates (default: 1)")
    add("--seed", type=int, help="default: the recipe's")
    add("--mixture", nargs="+", metavar="SOURCE=WEIGHT", help="shares of sources (default: size)")
    add("--cap", type=int, help="most windows of a source, domain and participant")
    add("--teacher-noise", action="store_true", help="corrupt labels as a cascade would (stage 1)")
    add("--videos", help="folder of videos, for corpora that are not packed")
    add("--validation", nargs="+", metavar="DIR", help="corpora to score on (default: --data's)")
    add("--evaluate-every", type=int, help="steps between scores (default: none)")
    add("--evaluate-windows", type=int, default=32, help="windows to score on (default: 32)")
    add("--log-every", type=int, default=10, help="steps between lines of OUT/log.jsonl")
    add("--save-every", type=int, default=500, help="steps between checkpoints (default: 500)")
    add("--keep", type=int, default=2, help="checkpoints to keep (default: 2)")
    add("--workers", type=int, default=0, help="processes that read ahead (default: 0)")
    add("--cache", type=Path, help="keep surveys and decoded pictures there, for all runs")
    add("--attention", choices=("sdpa", "eager"), default="sdpa", help="default: sdpa")
    add("--compile", action="store_true", help="compile layers (on a CPU: needs a C++ compiler)")
    add("--cpu", action="store_true", help="train on the CPU even where there is a GPU")
    add("--fsdp", action="store_true", help="shard the network over processes (FSDP2)")
    add("--allow-evaluation-clips", action="store_true", help="train on them all the same")
    add("--quiet", action="store_true", help="no progress bar")
    parser.set_defaults(verb=_train)


def _train(args: argparse.Namespace) -> int:
    try:
        import accelerate as _accelerate
    except ImportError:
        raise ImportError("training needs accelerate: pip install 'mint-hub[train]'") from None
    del _accelerate

    from torch import distributed

    from mint_hub.synth.teacher_noise import TeacherNoise
    from mint_hub.training.run import Request, train
    from mint_hub.training.trainer import Pace

    request = Request(
        recipe=_recipe(args),
        data=args.data,
        out=args.out,
        pace=Pace(
            steps=args.steps,
            log_every=args.log_every,
            save_every=args.save_every,
            keep=args.keep,
            evaluate_every=args.evaluate_every,
            evaluate_windows=args.evaluate_windows,
            micro_batch=args.micro_batch,
            workers=args.workers,
        ),
        init=args.init,
        config=_config(args.config),
        validation=args.validation,
        mixture=_mixture(args.mixture),
        cap_per_stratum=args.cap,
        noise=TeacherNoise() if args.teacher_noise else None,
        videos=args.videos,
        allow_evaluation_clips=args.allow_evaluation_clips,
        command="mint-hub " + shlex.join(sys.argv[1:]),
        cpu=args.cpu,
        progress=not args.quiet,
        fsdp=args.fsdp,
        cache=args.cache,
        attention=args.attention,
        compile=args.compile,
    )
    report = train(request)
    if distributed.is_available() and distributed.is_initialized():
        # Left to the interpreter's end, its threads now and then abort a process that is done.
        distributed.destroy_process_group()
    if int(os.environ.get("RANK", "0")) > 0:  # the first process says it for all
        return 0
    for warning in report.warnings:
        print(f"note: {warning}", file=sys.stderr)
    went_on = f", went on from step {report.resumed_from}" if report.resumed_from else ""
    losses = [line["loss"] for line in report.log if "loss" in line]
    last = f", loss {losses[0]:.4g} -> {losses[-1]:.4g}" if losses else ""
    print(f"{report.steps} steps{went_on}{last}; network in {report.model}")
    return 0


def _recipe(args: argparse.Namespace) -> "Recipe":
    from mint_hub.training.recipes import recipe_named

    recipe = recipe_named(args.recipe)
    warmup = args.warmup
    if warmup is None:
        warmup = min(recipe.optimisation.warmup_steps, args.steps // 10)
    settings = replace(recipe.optimisation, warmup_steps=warmup)
    if args.seed is not None:
        settings = replace(settings, seed=args.seed)
    window = recipe.window if args.window is None else args.window
    stride = recipe.stride if args.window is None else args.window
    stride = stride if args.stride is None else args.stride
    recipe = replace(recipe, optimisation=settings, window=window, stride=stride)
    if args.batch is not None:
        recipe = replace(recipe, batch=args.batch)
    if not args.lr_factor > 0:
        raise ValueError(f"--lr-factor: expected more than 0, got {args.lr_factor}")
    return recipe.scaled(args.lr_factor)


def _config(name: str | None) -> "MintConfig | None":
    from mint_hub.model.configuration_mint import MintConfig

    if name is None:
        return None
    if name in ("tiny", "full"):
        return MintConfig.tiny() if name == "tiny" else MintConfig.full()
    if not (Path(name) / "config.json").is_file():
        raise ValueError(f"--config: expected tiny, full or a folder with config.json, got {name}")
    return MintConfig.from_pretrained(name)


def _mixture(pairs: list[str] | None) -> dict[str, float] | None:
    if pairs is None:
        return None
    found: dict[str, float] = {}
    for pair in pairs:
        name, _, weight = pair.rpartition("=")
        try:
            found[name] = float(weight)
        except ValueError:
            name = ""
        if not name:
            raise ValueError(f"--mixture: expected SOURCE=WEIGHT, got {pair!r}")
    return found
