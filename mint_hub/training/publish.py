"""Make a checkpoint to hand out of training runs: the last run's network, and the record of all.

    python -m mint_hub.training.publish RUN [RUN ...] -o FOLDER [--results FILE ...] [--limits FILE]
        [--presence-share S]

Runs come in the order they were trained, each begun with the one before. The folder holds weights
in half precision, config.json, the processor, run.json (command, seed, data hash, settings of every
run), log.jsonl (the lines of all runs, frames counted through), their curve, and a card.

A presence head that learnt visible shares says a hand is there when half of it is. With
``--presence-share`` its bias is shifted so that it says so from that share on.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import torch

from mint_hub.cards.model import read_results, results_sections
from mint_hub.model.modeling_mint import MintModel
from mint_hub.model.processing_mint import MintProcessor
from mint_hub.training.curve import training_curve
from mint_hub.training.run import CARD_HEAD, MODEL, RUN, first_line, read_log
from mint_hub.training.trainer import LOG
from mint_hub.view import canvas

__all__ = ["publish"]

CURVE: Final = "curve.png"


def publish(
    runs: Sequence[Path],
    out: Path,
    results: Sequence[Path] = (),
    limits: str = "",
    presence_share: float = 0.5,
) -> Path:
    """Write the folder, whole or not at all; one that is there is replaced.

    Args:
        runs: folders of `mint-hub train`, first to last.
        out: the folder to make.
        results: ``results.json`` of evaluations of it, for the tables of its card.
        limits: what the card says it cannot do, Markdown.
        presence_share: what the presence head learnt of a hand that is told as present from now on.

    Raises:
        ValueError: no runs, a folder that holds no finished run, or a share out of (0, 1).
        CardError: a file is no result of an evaluation.

    """
    if not runs:
        raise ValueError("runs: expected at least one folder, got none")
    if not 0 < presence_share < 1:
        raise ValueError(
            f"presence_share: expected more than 0 and less than 1, got {presence_share}"
        )
    records = [_record(run) for run in runs]
    log = [line for k, run in enumerate(runs) for line in _lines(run, k, _frames(records[:k]))]
    model = MintModel.from_pretrained(runs[-1] / MODEL, dtype=torch.float32)
    with torch.no_grad():
        model.presence_head.classifier.bias.add_(math.log((1 - presence_share) / presence_share))
    torch.nn.Module.to(model, torch.bfloat16)
    tables = results_sections([read_results(path) for path in results]) if results else []
    staging, before = (out.with_name(f".{out.name}.{part}") for part in ("partial", "before"))
    shutil.rmtree(staging, ignore_errors=True)
    try:
        model.save_pretrained(staging)
        MintProcessor.for_config(model.config).save_pretrained(staging)
        facts = {"runs": records, "presence_share": presence_share}
        (staging / RUN).write_text(json.dumps(facts, indent=1) + "\n")
        (staging / LOG).write_text("".join(json.dumps(line) + "\n" for line in log))
        card = _card(model, records, tables, limits, presence_share)
        (staging / "README.md").write_text(card, encoding="utf-8")
        if any("eval_loss" in line for line in log):
            (staging / CURVE).write_bytes(canvas.png_bytes(training_curve(log)))
        if out.exists():
            out.rename(before)
        staging.rename(out)
        shutil.rmtree(before, ignore_errors=True)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return out


def _record(run: Path) -> dict[str, Any]:
    path = run / RUN
    if not path.is_file() or not (run / MODEL).is_dir():
        raise ValueError(f"{run}: expected a finished run of `mint-hub train` ({RUN}, {MODEL}/)")
    facts: dict[str, Any] = json.loads(path.read_text())
    return {**facts, "seed": facts["optimisation"]["seed"]}


def _frames(records: Sequence[dict[str, Any]]) -> int:
    return sum(r["steps"] * r["batch"] * r["window"] for r in records)


def _lines(run: Path, number: int, frames: int) -> list[dict[str, Any]]:
    """Lines of a run's log, with its number and frames counted from the first run on."""
    return [
        {"run": number, **line, "frames": frames + line.get("frames", 0)} for line in read_log(run)
    ]


def _card(
    model: MintModel,
    records: Sequence[dict[str, Any]],
    tables: Sequence[str],
    limits: str,
    presence_share: float,
) -> str:
    size = sum(p.numel() for p in model.parameters()) / 1e6
    height, width = model.config.image_size
    rows = "".join(
        f"| {k} | {r['recipe']} | {r['steps']} | {r['batch']} x {r['window']} | "
        f"{_frames([r]):,} | {r['seed']} | {r['data']} |\n"
        for k, r in enumerate(records, 1)
    )
    commands = "\n".join(r.get("command") or "(the Python API)" for r in records)
    parts = [
        first_line(name for r in records for name in r["sources"]),
        f"{size:.1f} million parameters, frames of {height} x {width} pixels, windows of "
        f"{model.config.window} frames, bfloat16.",
        "## Runs\n\n| | recipe | steps | windows x frames | frames seen | seed | data |\n"
        f"| --- | --- | --- | --- | --- | --- | --- |\n{rows}\n```sh\n{commands}\n```\n\n"
        f"Each run begins with the network of the one before. `{RUN}` has every setting, `{LOG}` "
        f"every score on the way, drawn in `{CURVE}` where there are any.",
    ]
    if presence_share != 0.5:
        parts.append(
            f"A hand is told as present from a predicted visible share of {presence_share:g} on: "
            "the presence head's bias was shifted so after training."
        )
    parts += ["## Scores\n\n" + "\n".join(tables).strip()] if tables else []
    parts += [f"## Limits\n\n{limits.strip()}"] if limits.strip() else []
    return CARD_HEAD + "\n" + "\n\n".join(parts) + "\n"


def main() -> None:
    """Run as a program."""
    parser = argparse.ArgumentParser(description="Make a checkpoint to hand out of training runs.")
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--results", nargs="*", type=Path, default=[])
    parser.add_argument("--limits", type=Path, help="Markdown")
    parser.add_argument("--presence-share", type=float, default=0.5)
    args = parser.parse_args()
    limits = args.limits.read_text(encoding="utf-8") if args.limits else ""
    sys.stdout.write(f"{publish(args.runs, args.out, args.results, limits, args.presence_share)}\n")


if __name__ == "__main__":
    main()
