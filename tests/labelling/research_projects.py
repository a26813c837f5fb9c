"""Stand-ins for other projects: their interfaces as documented, answering with known numbers.

Each writes a package or checkout into a folder; nothing of the projects themselves is here.
"""

import sys
from pathlib import Path

import numpy as np

from mint_hub.labelling.records import Clip, Intrinsics, Video
from mint_hub.loaders.video import probe

ULTRALYTICS = '''
from types import SimpleNamespace as N
import torch

class YOLO:
    """Finds the upper left block where it is red: a right hand, a left one and a cat."""

    def __init__(self, weights):
        assert open(weights).read() == "yolo weights"
        self.names = {0: "left", 1: "right", 2: "cat"}

    def predict(self, image, conf, verbose, device):
        blue, _, red = image[2, 2].tolist()
        found = [[1, 2, 30, 40], [50.5, 2, 60, 20], [0, 0, 9, 9]] if red > blue + 100 else []
        assert device is None and not verbose
        n = len(found)
        boxes = N(
            xyxy=torch.tensor(found).reshape(-1, 4),
            conf=torch.tensor([0.9, 0.5, 0.8][:n]),
            cls=torch.tensor([1.0, 0.0, 2.0][:n]),
        )
        return [N(boxes=boxes)]
'''

GEOCALIB = '''
import os
from types import SimpleNamespace as N
import torch

class GeoCalib(torch.nn.Module):
    """Answers with one focal for all pictures, as shared intrinsics are."""

    def __init__(self, weights="pinhole"):
        super().__init__()
        file = os.path.join(torch.hub.get_dir(), "geocalib", f"{weights}.tar")
        self.focal = float(open(file).read())

    def calibrate(self, img, camera_model="pinhole", priors=None, shared_intrinsics=False):
        assert img.dtype == torch.float32 and 0 <= img.min() and img.max() <= 1
        assert shared_intrinsics and camera_model == "pinhole"
        count = len(img)
        return {
            "camera": N(f=torch.full((count, 2), self.focal)),
            "gravity": N(vec3d=torch.tensor([[0.0, 1.0, 0.0]]).repeat(count, 1)),
            "focal_uncertainty": torch.full((count,), 0.02 * self.focal),
        }
'''

MOGE = '''
import torch

class MoGeModel(torch.nn.Module):
    """Depth grows with the column; the upper half is masked out, as sky is."""

    @classmethod
    def from_pretrained(cls, path):
        assert open(path).read() == "moge weights"
        return cls()

    def infer(self, image, fov_x=None, use_fp16=True):
        _, height, width = image.shape
        assert not use_fp16 and image.max() <= 1
        depth = (1.0 + torch.arange(width) / 100).repeat(height, 1)
        mask = torch.zeros(height, width, dtype=torch.bool)
        mask[height // 2 :] = True
        depth[mask.logical_not()] = torch.inf
        depth[-1, 0] = fov_x  # so that a test sees what was given
        return {"depth": depth, "mask": mask, "intrinsics": torch.eye(3)}
'''

DROID = '''
import numpy as np

class Droid:
    """Walks one unit a frame to the right, turned by 90 degrees about z."""

    def __init__(self, args):
        assert open(args.weights).read() == "droid weights" and args.disable_vis
        self.size, self.seen = args.image_size, 0

    def track(self, t, image, depth=None, intrinsics=None):
        assert t == self.seen and list(image.shape) == [1, 3, *self.size]
        assert image[0, 2, 2, 2] > image[0, 0, 2, 2] + 100  # red is the last channel of BGR
        self.seen, self.intrinsics = t + 1, intrinsics.tolist()

    def terminate(self, stream):
        poses = np.zeros((len(list(stream)), 7))
        poses[:, 0] = np.arange(len(poses))
        poses[:, 1:3] = self.intrinsics[:2]
        poses[:, 5:] = np.sqrt(0.5)
        return poses
'''

HAWOR_DETECT = """
import glob, os

def detect_track_video(args):
    folder = args.video_path[: -len(".mp4")]
    images = sorted(glob.glob(os.path.join(folder, "extracted_images", "*.jpg")))
    assert os.path.exists("weights/external/detector.pt")  # it works from its own folder
    return 0, len(images), folder, images
"""

HAWOR_MOTION = """
import os, shutil

def hawor_motion_estimation(args, start_idx, end_idx, seq_folder):
    assert open(args.checkpoint).read() == "hawor weights"
    assert abs(args.img_focal - 80.0) < 1e-6
    recorded = os.path.join(os.getcwd(), "recorded")
    if os.path.exists(recorded):
        shutil.copytree(recorded, os.path.join(seq_folder, "cam_space"))
    return {}, args.img_focal
"""

MEGASAM_MONO = """
import argparse, os, numpy as np
parser = argparse.ArgumentParser()
for name in ("--encoder", "--load-from", "--img-path", "--outdir"):
    parser.add_argument(name, required=True)
args = parser.parse_args()
assert os.path.exists("Depth-Anything/run_videos.py")  # it runs from the checkout
assert open(args.load_from).read() == "mono weights"
os.makedirs(args.outdir)
for name in sorted(os.listdir(args.img_path)):
    np.save(os.path.join(args.outdir, name[:-4] + ".npy"), np.ones((6, 8), np.float32))
"""

MEGASAM_METRIC = """
import argparse, os, numpy as np
parser = argparse.ArgumentParser()
for name in ("--img-path", "--outdir", "--scene-name"):
    parser.add_argument(name, required=True)
args = parser.parse_args()
folder = os.path.join(args.outdir, args.scene_name)
os.makedirs(folder)
assert os.environ["PYTHONPATH"] == os.path.abspath("UniDepth")
for t, name in enumerate(sorted(os.listdir(args.img_path))):
    depth = np.random.default_rng(t).uniform(0.4, 3, (48, 64)).astype(np.float32)
    depth[0] = np.inf
    np.savez(os.path.join(folder, name[:-4] + ".npz"), depth=depth, fov=np.float64(33.0))
"""

MEGASAM_TRACK = """
import argparse, glob, os, numpy as np
parser = argparse.ArgumentParser()
names = ("--datapath", "--weights", "--scene_name", "--mono_depth_path", "--metric_depth_path")
for name in names:
    parser.add_argument(name, required=True)
parser.add_argument("--disable_vis", action="store_true")
args = parser.parse_args()
assert open(args.weights).read() == "megasam weights"
here = os.path.dirname(os.path.abspath(__file__))
droid = os.path.join(os.path.dirname(here), "base", "droid_slam")
assert os.environ["PYTHONPATH"] == droid and os.getcwd() != os.path.dirname(here)
mono = sorted(glob.glob(os.path.join(args.mono_depth_path, args.scene_name, "*.npy")))
metric = sorted(glob.glob(os.path.join(args.metric_depth_path, args.scene_name, "*.npz")))
assert len(mono) == len(metric) == len(os.listdir(args.datapath))
fov = float(np.load(metric[0])["fov"])
factor = 1.8  # depth, and with it the path, is multiplied by this
depths = np.stack([np.load(file)["depth"][:48, :64] for file in metric]) * factor
depths[:, :, 0] = 1e-6  # what was too near becomes a hole
path = np.tile(np.eye(4), (len(metric), 1, 1))
path[:, 0, 3] = factor * 0.01 * np.arange(len(metric))
focal = 32 / np.tan(np.radians(fov) / 2)
os.makedirs("outputs")
np.savez(
    f"outputs/{args.scene_name}_droid.npz",
    images=np.zeros((1, 1, 1, 3), np.uint8),
    depths=depths.astype(np.float32),
    intrinsic=np.diag([focal, focal, 1]),
    cam_c2w=path,
)
"""


def write_files(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


def python_with(folder: Path, files: dict[str, str]) -> str:
    """Make an interpreter that has these modules beside this one's."""
    write_files(folder, files)
    path = folder / "python"
    path.write_text(f'#!/bin/sh\nPYTHONPATH="{folder}" exec "{sys.executable}" "$@"\n')
    path.chmod(0o755)
    return str(path)


def clip_of(file: Path, count: int, first: int = 0, focal: float | None = None) -> Clip:
    """Take a stretch of a file as a clip, under a pinhole of this focal length in pixels."""
    height, width = probe(file).image_size_hw
    intrinsics = None
    if focal is not None:
        fov = 2 * np.arctan(height / 2 / focal), 2 * np.arctan(width / 2 / focal)
        intrinsics = Intrinsics((float(fov[0]), float(fov[1])), "given", 1.0)
    times = 10.0 + np.arange(count) / 30
    key = f"{file.stem}-{first}"
    return Clip(key, file, first, (height, width), 30.0, times, intrinsics=intrinsics)


def video_of(*clips: Clip) -> Video:
    one = clips[0]
    return Video("a", "a", "user", one.video, 1.0, 30.0, one.image_size_hw, clips=clips)
