"""The trainer: transformers' own, with our learning rates, clipping, freezing, scores and saving.

A step's loss is the mean over its windows, whatever processes and accumulation they are spread
over. What is saved appears whole or not at all, and loads as a model.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
from safetensors import SafetensorError
from transformers.trainer import Trainer
from transformers.trainer_callback import PrinterCallback, TrainerCallback
from transformers.training_args import TrainingArguments
from transformers.utils import logging as transformers_logging

from mint_hub.loaders.atomic import replacing
from mint_hub.model.layers_mint import MintConvolutionalStem, MintLayer
from mint_hub.model.modeling_mint import MintModel
from mint_hub.training.data import PositionDataset, TrainingWindows, collate
from mint_hub.training.recipes import PARTS, Optimisation, Recipe
from mint_hub.training.validation import gathered, score_windows, spread_numbers

__all__ = [
    "MintTrainer",
    "Pace",
    "compile_layers",
    "last_checkpoint",
    "prepare",
    "training_arguments",
]

STAGING: Final = ".saving"
LOG: Final = "log.jsonl"
_PREFIX: Final = "checkpoint-"
_SAVING_ERRORS: Final = (OSError, RuntimeError, SafetensorError)


@dataclass(frozen=True)
class Pace:
    """How often a run writes and looks up.

    Attributes:
        steps: of the whole run; the schedule ends there.
        log_every: steps between lines of the log.
        save_every: steps between checkpoints.
        keep: checkpoints that stay.
        evaluate_every: steps between scores on validation windows; None: never.
        evaluate_windows: how many of those windows.
        micro_batch: windows at once in a process; None: its whole share of a step.
        workers: processes that read ahead, for each process that trains.

    """

    steps: int
    log_every: int = 10
    save_every: int = 500
    keep: int = 2
    evaluate_every: int | None = None
    evaluate_windows: int = 32
    micro_batch: int | None = None
    workers: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "log_every", "save_every", "keep", "evaluate_windows"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected at least 1, got {getattr(self, name)}")
        if self.workers < 0:
            raise ValueError(f"workers: expected at least 0, got {self.workers}")
        for name in ("evaluate_every", "micro_batch"):
            if (value := getattr(self, name)) is not None and value < 1:
                raise ValueError(f"{name}: expected at least 1, got {value}")


def training_arguments(
    out: Path,
    recipe: Recipe,
    pace: Pace,
    *,
    world_size: int = 1,
    cpu: bool = False,
    progress: bool = True,
    **more: Any,
) -> TrainingArguments:
    """Say a recipe in transformers' words.

    Args:
        out: folder of the run.
        recipe: what is trained.
        pace: how often what is written.
        world_size: processes that share a step.
        cpu: train on the CPU even where there is a GPU.
        progress: show a bar.
        more: what TrainingArguments takes beside, such as ``fsdp``.

    Raises:
        ValueError: a batch that cannot be split so.

    """
    settings = recipe.optimisation
    share, rest = divmod(recipe.batch, world_size)
    micro = pace.micro_batch or max(share, 1)
    if rest or share % micro:
        raise ValueError(
            f"batch: expected a multiple of {world_size} processes x {micro} windows at once, got "
            f"{recipe.batch}"
        )
    return TrainingArguments(
        output_dir=str(out),
        max_steps=pace.steps,
        per_device_train_batch_size=micro,
        gradient_accumulation_steps=share // micro,
        learning_rate=max(recipe.learning_rates.values()),
        adam_beta1=settings.betas[0],
        adam_beta2=settings.betas[1],
        weight_decay=settings.weight_decay,
        max_grad_norm=0.0,  # clipped by value instead
        lr_scheduler_type="cosine",
        warmup_steps=settings.warmup_steps,
        bf16=settings.bf16,
        seed=settings.seed,
        logging_strategy="steps",
        logging_steps=pace.log_every,
        logging_first_step=True,
        logging_nan_inf_filter=False,
        save_strategy="steps",
        save_steps=pace.save_every,
        eval_strategy="no" if pace.evaluate_every is None else "steps",
        eval_steps=pace.evaluate_every,
        train_sampling_strategy="sequential",  # the data set is in order already
        remove_unused_columns=False,
        label_names=["labels"],
        dataloader_num_workers=pace.workers,
        dataloader_pin_memory=torch.cuda.is_available() and not cpu,
        ddp_find_unused_parameters=False,
        use_cpu=cpu or not torch.accelerator.is_available(),
        disable_tqdm=not progress,
        report_to="none",
        **more,
    )


def prepare(model: MintModel, recipe: Recipe) -> None:
    """Freeze what the recipe does not train, and give the model its loss."""
    trained = recipe.trained
    for part in PARTS:
        for parameter in getattr(model, part).parameters():
            parameter.requires_grad_(part in trained)
    model.encoder.mask_token.requires_grad_(False)
    model.loss_settings = recipe.loss


def compile_layers(model: MintModel) -> None:
    """Compile stem and transformer layers in place; scores during training run as they are."""
    for module in model.modules():
        if isinstance(module, MintLayer | MintConvolutionalStem):
            module.compile(dynamic=False)


def last_checkpoint(out: Path) -> Path | None:
    """Return the newest checkpoint of a run, or None."""
    found = [path for path in out.glob(f"{_PREFIX}*") if path.name[len(_PREFIX) :].isdigit()]
    return max(found, key=lambda path: int(path.name[len(_PREFIX) :]), default=None)


class ClipByValue(TrainerCallback):
    """Clip every element of every gradient, after unscaling and before the step."""

    def __init__(self, limit: float) -> None:
        self.limit = limit

    def on_pre_optimizer_step(self, args: Any, state: Any, control: Any, **kwargs: Any) -> None:
        """Clip; called by the trainer."""
        torch.nn.utils.clip_grad_value_(kwargs["model"].parameters(), self.limit)


class MintTrainer(Trainer):
    """Trains a `MintModel` on windows by a recipe.

    Args:
        model: as it begins; parts that the recipe does not train are frozen.
        recipe: what is trained.
        pace: how often what is written.
        args: see `training_arguments`.
        data: windows in the order they are read.
        validation: windows to score on, where ``pace`` says so.
        card: text of a checkpoint's README.md, given what is known when it is saved.

    Raises:
        RuntimeError: (while training) a loss that is not finite; names the step.
        OSError: (while training) a checkpoint that cannot be written; nothing is left half-written.

    """

    def __init__(
        self,
        model: MintModel,
        recipe: Recipe,
        pace: Pace,
        args: TrainingArguments,
        data: PositionDataset,
        validation: TrainingWindows | None = None,
        card: Callable[[Mapping[str, Any]], str] | None = None,
    ) -> None:
        prepare(model, recipe)
        self.recipe, self.pace, self.validation, self.card = recipe, pace, validation, card
        self._staging: Path | None = None
        self._terms: dict[str, list[torch.Tensor]] = {}
        self._processor = data.windows.processor  # the base class would look for a tokenizer
        any_data: Any = data
        super().__init__(
            model=model,
            args=args,
            data_collator=collate,
            train_dataset=any_data,
            eval_dataset=any_data if pace.evaluate_every is not None else None,
            callbacks=[ClipByValue(recipe.optimisation.clip_value)],
        )
        self.remove_callback(PrinterCallback)

    # ---------------------------------------------------------------- steps

    def create_optimizer(self, model: Any = None) -> torch.optim.Optimizer:
        """Make AdamW with a group a part, at the part's learning rate."""
        network: Any = self.model if model is None else model
        made: Any = self.optimizer
        self.optimizer = make_optimizer(network, self.recipe) if made is None else made
        return self.optimizer

    def compute_loss(
        self,
        model: Any,
        inputs: Any,
        return_outputs: bool = False,
        num_items_in_batch: Any = None,
    ) -> Any:
        """Mean loss over the windows at hand; its terms are kept for the log."""
        output = model(**inputs)
        if not torch.isfinite(output.loss):
            wrong = [n for n, value in output.losses.items() if not torch.isfinite(value)]
            raise RuntimeError(
                f"step {self.state.global_step + 1}: the loss is {float(output.loss.detach())} "
                f"({', '.join(wrong)}): training diverged; lower the learning rate"
            )
        for name, value in output.losses.items():
            self._terms.setdefault(name, []).append(value.detach())
        return (output.loss, output) if return_outputs else output.loss

    def log(self, logs: dict[str, float], start_time: float | None = None) -> None:
        """Add the terms of the loss and the frames seen, and rewrite the log file."""
        if "loss" in logs:
            for name, values in self._terms.items():
                logs[name] = float(torch.stack(values).mean())
            self._terms.clear()
        logs["frames"] = self.state.global_step * self.recipe.batch * self.recipe.window
        super().log(logs, start_time)
        if self.is_world_process_zero():
            lines = (json.dumps(line) + "\n" for line in self.state.log_history)
            with replacing(Path(self.args.output_dir or ".") / LOG) as temporary:
                temporary.write_text("".join(lines))

    # --------------------------------------------------------------- scores

    def evaluate(
        self,
        eval_dataset: Any = None,
        ignore_keys: list[str] | None = None,
        metric_key_prefix: str = "eval",
    ) -> dict[str, float]:
        """Score the network on validation windows; every process takes its part of them."""
        if self.validation is None:
            return {}
        numbers = spread_numbers(self.validation, self.pace.evaluate_windows)
        rank, world = self.args.process_index, self.args.world_size
        # A sharded network runs in step everywhere: every process takes as many windows.
        shared = len(numbers) // world * world
        mine = numbers[rank:shared:world] if shared else numbers
        network: Any = self.accelerator.unwrap_model(self.model)
        with torch.compiler.set_stance("force_eager"):
            scores = score_windows(network, self.validation, mine, self.recipe.optimisation.bf16)
        scores = gathered(scores) if shared else scores
        metrics = {f"{metric_key_prefix}_{k}": v for k, v in scores.metrics().items()}
        self.log(dict(metrics))
        self.control = self.callback_handler.on_evaluate(
            self.args, self.state, self.control, metrics
        )
        return metrics

    # --------------------------------------------------------------- saving

    def save_now(self) -> None:
        """Write a checkpoint of this step; errors as of `save_folder`."""
        self._save_checkpoint(self.model, None)

    def save_folder(self, path: Path) -> None:
        """Write the network with processor and card as a folder, whole or not at all.

        Raises:
            OSError: it cannot be written.

        """
        staging = path.parent / STAGING
        with _cleared(staging, path.name):
            self.save_model(str(staging / path.name), _internal_call=True)
        self._publish(staging, path)

    def _save_checkpoint(self, model: Any, trial: Any) -> None:
        out = Path(self.args.output_dir or ".")
        name = f"{_PREFIX}{self.state.global_step}"
        self._staging = out / STAGING
        try:
            with _cleared(self._staging, name):
                super()._save_checkpoint(model, trial)
            self._publish(self._staging, out / name)
        finally:
            self._staging = None
        if self.is_world_process_zero():
            self._forget(out)

    def _get_output_dir(self, trial: Any) -> str:
        return str(self._staging or self.args.output_dir)

    def _save(self, output_dir: str | None = None, state_dict: Any = None) -> None:
        shown = transformers_logging.is_progress_bar_enabled()
        transformers_logging.disable_progress_bar()  # one for every file of weights, however small
        try:
            super()._save(output_dir, state_dict)
        finally:
            if shown:
                transformers_logging.enable_progress_bar()
        if not self.args.should_save:
            return
        folder = Path(output_dir or self.args.output_dir or ".")
        self._processor.save_pretrained(folder)
        (folder / "training_args.bin").unlink(missing_ok=True)  # a pickle that nothing needs
        if self.card is not None:
            facts = {
                "steps": self.state.global_step,
                "frames": self.state.global_step * self.recipe.batch * self.recipe.window,
            }
            (folder / "README.md").write_text(self.card(facts), encoding="utf-8")

    def _publish(self, staging: Path, path: Path) -> None:
        """Give the finished folder its name, once every process has written its part."""
        self.accelerator.wait_for_everyone()
        if self.is_world_process_zero():
            if path.exists():
                path.rename(staging / "before")
            (staging / path.name).rename(path)
            shutil.rmtree(staging, ignore_errors=True)
        self.accelerator.wait_for_everyone()

    def _forget(self, out: Path) -> None:
        found = [path for path in out.glob(f"{_PREFIX}*") if path.name[len(_PREFIX) :].isdigit()]
        found.sort(key=lambda path: int(path.name[len(_PREFIX) :]))
        for path in found[: -self.pace.keep]:
            shutil.rmtree(path, ignore_errors=True)


class _cleared:  # noqa: N801 (used like a function)
    """A block that writes below ``staging``; when it fails, nothing of it stays."""

    def __init__(self, staging: Path, name: str) -> None:
        self.staging, self.name = staging, name

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        if error is None:
            return
        shutil.rmtree(self.staging, ignore_errors=True)
        if isinstance(error, _SAVING_ERRORS):
            raise OSError(
                f"{self.staging.parent / self.name}: could not be saved ({error}); nothing of it "
                "was left, and earlier checkpoints are as they were. Make room and run the same "
                "command again"
            ) from error


def make_optimizer(model: torch.nn.Module, recipe: Recipe) -> torch.optim.AdamW:
    """AdamW over the trained parts of a model, one group each."""
    settings: Optimisation = recipe.optimisation
    groups: list[dict[str, Any]] = []
    for part in recipe.trained:
        parameters = [
            parameter
            for name, parameter in model.named_parameters()
            if name.removeprefix("module.").startswith(f"{part}.") and parameter.requires_grad
        ]
        groups.append({"params": parameters, "lr": recipe.learning_rates[part], "name": part})
    return torch.optim.AdamW(groups, betas=settings.betas, weight_decay=settings.weight_decay)
