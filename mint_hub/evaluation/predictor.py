"""Where predictions come from: a checkpoint that is run, or labels that lie in a folder.

Predictions of a checkpoint are kept under a name made of the weights, the clip, the options and the
code, so that a second evaluation runs nothing that the first one did, and nothing else serves it.
"""

import hashlib
import json
import resource
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import MODEL_FPS
from mint_hub.evaluation.bench_shards import is_corpus, label_files
from mint_hub.evaluation.clips import BenchmarkError, Clip, MissingFilesError
from mint_hub.geometry.camera import fov_vh_to_K
from mint_hub.geometry.hand_model import HandModel
from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.schema import Episode

NOT_THE_MODEL: Final = ("_name_or_path", "transformers_version")
"""Entries of a configuration that say where it came from and who wrote it."""

ONE_LENS_RAD: Final = 1e-3

if TYPE_CHECKING:
    from mint_hub.inference.runner import MintRunner, RunSettings


@dataclass(frozen=True)
class Prediction:
    """A clip's prediction, and what making it took; no seconds where it was not made now.

    ``warm_up`` says that it was the first that its process made.
    """

    episode: Episode
    seconds: float | None = None
    peak_bytes: int | None = None
    warm_up: bool = False


@dataclass(frozen=True)
class Predictor:
    """What is evaluated, in words that travel to other processes.

    Attributes:
        what: folder of labels (saved episodes, or a corpus), or folder or hub id of a checkpoint.
        name: what tables call it.
        kind: "labels" or "checkpoint".
        settings: of a checkpoint's run; None for the usual ones.
        known_camera: a checkpoint is told each clip's true intrinsics.
        device: a checkpoint's; None for the best here.
        dtype: a checkpoint's.
        revision: of a hub repository.
        mano_dir: folder with the user's MANO files.
        cache_dir: where predictions are kept.

    """

    what: str
    name: str
    kind: str
    settings: "RunSettings | None" = None
    known_camera: bool = False
    device: str | None = None
    dtype: str = "auto"
    revision: str | None = None
    mano_dir: str | None = None
    cache_dir: str | None = None

    @classmethod
    def of(cls, what: str, name: str | None = None, **options: Any) -> "Predictor":
        """Look at what lies there: a checkpoint has config.json, labels are told by their files.

        Raises:
            MissingFilesError: a local path with nothing at it.

        """
        folder = Path(what).expanduser()
        if not folder.is_dir() and (what.startswith((".", "/", "~")) or folder.exists()):
            raise MissingFilesError(
                f"{what}: expected a folder with a checkpoint or labels, found none"
            )
        configured = (folder / "config.json").is_file()
        labels = (
            not configured and folder.is_dir() and (is_corpus(folder) or any(folder.rglob("*.npz")))
        )
        if folder.is_dir() and not labels and not configured:
            raise MissingFilesError(
                f"{what}: expected a checkpoint (config.json), saved episodes (.npz) or a corpus, "
                "found neither"
            )
        kind = "labels" if labels else "checkpoint"
        return cls(what, name or folder.name or what, kind, **options)

    def open(self) -> "OpenPredictor":
        """Load it, in the process that uses it."""
        return OpenLabels(self) if self.kind == "labels" else OpenCheckpoint(self)


class OpenPredictor:
    """A predictor whose files are open."""

    hand_model: HandModel | None = None

    @property
    def facts(self) -> dict[str, Any]:
        """What the results say of it."""
        raise NotImplementedError

    def predict(self, clip: Clip) -> Prediction:
        """Predict a clip.

        Raises:
            BenchmarkError: there is no prediction of it, or there are no pictures to make one from.

        """
        raise NotImplementedError


class OpenLabels(OpenPredictor):
    """Labels by key."""

    def __init__(self, spec: Predictor) -> None:
        folder = Path(spec.what).expanduser()
        self._spec, self._where = spec, dict[str, Any]()
        self._last: tuple[str, Episode] | None = None
        if is_corpus(folder):
            for path in sorted(folder.glob("*/*/shards.json")):
                reader = CorpusReader(folder, path.parent.parent.name, path.parent.name)
                self._where |= {reader.key(i): (reader, i) for i in range(len(reader))}
        else:
            self._where |= label_files(folder)
        if spec.mano_dir is not None:
            self.hand_model = HandModel.default(spec.mano_dir)

    @property
    def facts(self) -> dict[str, Any]:
        """Name, kind and how many there are."""
        return {"name": self._spec.name, "kind": "labels", "episodes": len(self._where)}

    def predict(self, clip: Clip) -> Prediction:
        """Read the labels of a clip; those of a whole clip serve its windows.

        Raises:
            MissingFilesError: there are none.
            BenchmarkError: those of the whole clip have another number of frames than it.

        """
        place, key = self._where.get(clip.key), clip.key
        start = 0
        if place is None:
            key, number = clip.whole
            place, start = self._where.get(key), number
        if place is None:
            raise MissingFilesError(
                f"{self._spec.what}: expected labels of {clip.key}, found none (of "
                f"{len(self._where)} episodes, the first is {min(self._where)})"
            )
        if self._last is None or self._last[0] != key:  # windows of a clip come one by one
            episode = Episode.load(place) if isinstance(place, Path) else place[0][place[1]]
            self._last = (key, episode)
        episode = self._last[1]
        if key == clip.key:
            return Prediction(episode)
        if episode.num_frames != clip.whole_frames:
            raise BenchmarkError(
                f"{self._spec.what}: {key}: expected labels of {clip.whole_frames} frames, as the "
                f"truth has, got {episode.num_frames}"
            )
        return Prediction(episode.window(start, clip.truth.num_frames))


class OpenCheckpoint(OpenPredictor):
    """A model that is run on pictures, and the cache of what it said."""

    def __init__(self, spec: Predictor) -> None:
        self._spec, self._warm = spec, False
        if spec.mano_dir is not None:
            self.hand_model = HandModel.default(spec.mano_dir)

    @cached_property
    def _runner(self) -> "MintRunner":
        from mint_hub.inference.opening import open_model, runner_of

        spec = self._spec
        model = open_model(spec.what, spec.dtype, spec.revision)
        return runner_of(model, [spec.device] if spec.device else [], self.hand_model)

    @cached_property
    def weights_hash(self) -> str:
        """16 hex digits of all weights and the configuration, whatever libraries wrote them."""
        import torch

        model = self._runner.models[0]
        config = {k: v for k, v in model.config.to_dict().items() if k not in NOT_THE_MODEL}
        digest = hashlib.blake2b(json.dumps(config, sort_keys=True, default=str).encode())
        for name, weight in sorted(model.state_dict().items()):
            plain = weight.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy()
            digest.update(f"{name} {tuple(weight.shape)} {weight.dtype}".encode())
            digest.update(np.ascontiguousarray(plain).data)
        return digest.hexdigest()[:16]

    @property
    def facts(self) -> dict[str, Any]:
        """Name, weights, settings and device."""
        model = self._runner.models[0]
        settings = self._settings(MODEL_FPS).resolved(model.config.window)
        return {
            "name": self._spec.name,
            "kind": "checkpoint",
            "weights": self.weights_hash,
            "parameters": int(sum(p.numel() for p in model.parameters())),
            "revision": getattr(model.config, "_commit_hash", None) or self._spec.revision,
            "device": str(model.device),
            "dtype": str(model.dtype).removeprefix("torch."),
            "settings": asdict(settings),
            "known_camera": self._spec.known_camera,
        }

    def predict(self, clip: Clip) -> Prediction:
        """Run the model on a clip, or read what it said before."""
        if clip.frames is None:
            words = f"no pictures to run {self._spec.what} on: {clip.without_frames}"
            if not Path(self._spec.what).expanduser().is_dir():
                words += (
                    f" (there is no folder {self._spec.what}: it is taken for a hub repository)"
                )
            raise MissingFilesError(f"{clip.key}: {words}")
        path = self._cached(clip)
        if path is not None and path.is_file():
            return Prediction(Episode.load(path))
        images = np.stack(list(clip.frames.images()))
        if len(images) != clip.truth.num_frames:
            raise BenchmarkError(
                f"{clip.key}: expected {clip.truth.num_frames} pictures, as the truth has, got "
                f"{len(images)}"
            )
        begun = time.perf_counter()
        settings = self._settings(clip.truth.fps)
        made = self._runner.run(images, settings, camera=self._camera(clip, images), key=clip.key)
        seconds = time.perf_counter() - begun
        if path is not None:
            with replacing(path) as temporary:
                made.save(temporary)
        first, self._warm = not self._warm, True
        return Prediction(made, seconds, _peak_bytes(self._runner.models[0].device.type), first)

    def _settings(self, fps: float) -> "RunSettings":
        from mint_hub.inference.runner import RunSettings

        return replace(self._spec.settings or RunSettings(), fps=fps)

    def _camera(self, clip: Clip, images: NDArray[np.uint8]) -> NDArray[np.float64] | None:
        """Return K (3, 3) of a clip's pictures, where they are to be told."""
        if not self._spec.known_camera:
            return None
        fov = clip.truth.fov_vh_rad.astype(np.float64)
        if np.ptp(fov, axis=0).max() > ONE_LENS_RAD:
            low, high = np.rad2deg([fov[:, 1].min(), fov[:, 1].max()])
            raise BenchmarkError(
                f"{clip.key}: expected one horizontal field of view, to be told to the checkpoint, "
                f"got {low:.1f} to {high:.1f} degrees"
            )
        return fov_vh_to_K(fov.mean(0), images.shape[1:3])

    def _cached(self, clip: Clip) -> Path | None:
        if self._spec.cache_dir is None:
            return None
        model = self._runner.models[0]
        settings = asdict(self._settings(clip.truth.fps).resolved(model.config.window))
        options: Mapping[str, Any] = settings | {
            "dtype": str(model.dtype),
            "device": model.device.type,
        }
        if self._spec.known_camera:
            options |= {"known_camera": True}
        facts = [self.weights_hash, clip.stamp(), options, _code_hash()]
        words = json.dumps(facts, sort_keys=True, default=str)
        name = hashlib.sha256(words.encode()).hexdigest()[:32]
        return Path(self._spec.cache_dir) / "predictions" / name[:2] / f"{name}.npz"


@cache
def _code_hash() -> str:
    """16 hex digits that change with the code that a prediction goes through, and with torch's."""
    import torch

    digest = hashlib.sha256(torch.__version__.encode())
    package = Path(__file__).parents[1]
    for room in ("geometry", "inference", "loaders", "model"):
        for path in sorted((package / room).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _peak_bytes(device: str) -> int:
    """Peak memory so far: of the device, or of this process."""
    if device == "cuda":
        import torch

        return int(torch.cuda.max_memory_allocated())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(peak * (1 if sys.platform == "darwin" else 1024))
