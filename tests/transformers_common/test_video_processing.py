"""MintVideoProcessor under the common video processor tests of transformers."""

import unittest
from typing import Any

from transformers.models.auto.video_processing_auto import AutoVideoProcessor

from mint_hub.model.processing_mint import MintVideoProcessor
from tests.transformers_common import sdist

common = sdist.load("test_video_processing_common")
common.AutoVideoProcessor = AutoVideoProcessor  # the usual name stands for it with torchvision only

SIZE = {"height": 28, "width": 42}


class MintVideoProcessorTester:
    batch_size = 3
    num_frames = 4
    num_channels = 3

    def expected_output_video_shape(self, videos: list[Any]) -> tuple[int, ...]:
        return self.num_frames, 3, SIZE["height"], SIZE["width"]

    def prepare_video_inputs(self, equal_resolution: bool = False, return_tensors: str = "pil"):
        return common.prepare_video_inputs(
            batch_size=self.batch_size,
            num_frames=self.num_frames,
            num_channels=self.num_channels,
            min_resolution=30,
            max_resolution=80,
            equal_resolution=equal_resolution,
            return_tensors=return_tensors,
        )


class MintVideoProcessorTest(common.VideoProcessingTestMixin, unittest.TestCase):
    fast_video_processing_class = MintVideoProcessor
    input_name = "pixel_values"
    test_cast_dtype = True

    def setUp(self) -> None:
        super().setUp()
        self.video_processor_tester = MintVideoProcessorTester()
        self.video_processor_dict = {"size": SIZE, "do_normalize": False, "fps": 10.0}

    def test_video_processor_from_dict_with_kwargs(self):
        # The mixin has sizes by shortest edge and crops; ours takes neither.
        settings = self.video_processor_dict
        assert MintVideoProcessor.from_dict(settings).size == SIZE
        other = {"height": 14, "width": 70}
        processor = MintVideoProcessor.from_dict(settings, size=other, fps=5.0)
        assert processor.size == other
        assert processor.fps == 5.0

    def test_override_instance_attributes_does_not_affect_other_instances(self):
        # The mixin skips itself without a list of means; ours normalises inside the network.
        first, second = MintVideoProcessor(), MintVideoProcessor()
        before = dict(second.size)
        first.size["height"] = -1
        first.fps = -1.0
        assert dict(second.size) == dict(MintVideoProcessor().size) == before
        assert second.fps == MintVideoProcessor.fps == 30.0
