"""Network time over a video with overlapping windows: ours against the plain network.

``python benchmarks/forward.py [--frames 152] [--rounds 5]``. In one run, on the same random weights
and frames, in turns: `plain_mint` window by window from pixels; our model window by window from
pixels; our runner's way, which encodes each frame once. Outputs are compared before anything is
timed. Writes ``benchmarks/results/forward-<date>.json``.
"""

import argparse
from collections.abc import Callable
from statistics import median
from time import perf_counter

import torch
from _report import write_report
from plain_mint import plain_forward

from mint_hub.inference.network import WindowNetwork
from mint_hub.model.configuration_mint import MintConfig
from mint_hub.model.loading_mint import cast_weights
from mint_hub.model.modeling_mint import MintModel
from mint_hub.windows import windows

LENGTH = 32
RELEASE_STEM = {"image_size": (112, 140), "patch_size": 14, "patch_stem": "linear"}
"""`plain_mint` is the release's network, which embeds patches so."""


def make_model(dtype: torch.dtype) -> MintModel:
    torch.manual_seed(0)
    model = MintModel(MintConfig.tiny(**RELEASE_STEM)).eval()
    cast_weights(model, dtype)
    return model


def largest_difference(model: MintModel, pixels: torch.Tensor) -> float:
    plain = plain_forward(dict(model.state_dict()), model.config, pixels)
    ours = model(pixel_values=pixels)
    pairs = (
        (plain["pose"], ours.pose_encoding[..., :7]),
        (plain["fov"], ours.pose_encoding[..., 7:]),
        (plain["hands"], ours.hand_state),
        (plain["presence"], ours.presence_logits),
    )
    return max(float((a - b).abs().max()) for a, b in pairs)


def ways(model: MintModel, frames: torch.Tensor, overlap: int) -> dict[str, Callable[[], object]]:
    cut = windows(len(frames), LENGTH, overlap)
    weights = dict(model.state_dict())
    return {
        "plain": lambda: [
            plain_forward(weights, model.config, frames[w.frames][None]) for w in cut
        ],
        "ours_every_window_from_pixels": lambda: [
            model(pixel_values=frames[w.frames][None]) for w in cut
        ],
        "ours_each_frame_encoded_once": lambda: list(
            WindowNetwork([model], LENGTH, overlap, 1).predict(iter(frames))
        ),
    }


def in_turns(calls: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Median seconds of each call; the calls take turns, so that drift hits all alike."""
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for round_number in range(rounds + 1):
        for name, call in calls.items():
            start = perf_counter()
            call()
            if round_number:  # the first is a warm-up
                taken[name].append(perf_counter() - start)
    return {name: median(values) for name, values in taken.items()}


@torch.inference_mode()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=152)
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    height, width = MintConfig.tiny(**RELEASE_STEM).image_size
    frames = torch.rand(args.frames, 3, height, width, generator=torch.Generator().manual_seed(1))
    results = {}
    for dtype in (torch.float32, torch.bfloat16):
        model = make_model(dtype)
        name = str(dtype).removeprefix("torch.")
        results[name] = {"largest_difference": largest_difference(model, frames[None, :LENGTH])}
        for overlap in (0, 8, 16):
            taken = in_turns(ways(model, frames, overlap), args.rounds)
            plain, pixels, once = taken.values()
            results[name][f"overlap_{overlap}"] = {
                **{f"{way}_frames_a_s": round(args.frames / s, 1) for way, s in taken.items()},
                "ours_over_plain_speed": round(plain / once, 2),
                "saved_by_encoding_once": round(1 - once / pixels, 3),
            }
            print(name, overlap, results[name][f"overlap_{overlap}"])
    settings = {
        "config": "MintConfig.tiny(**RELEASE_STEM)",
        "image_size": [height, width],
        "window": LENGTH,
        "frames": args.frames,
        "rounds": args.rounds,
        "torch_threads": torch.get_num_threads(),
    }
    print(write_report("forward", results, settings))


if __name__ == "__main__":
    main()
