"""MintProcessor under the common processor tests of transformers."""

import unittest

import pytest
import torch
from transformers.processing_utils import ProcessorMixin

from mint_hub.model.processing_mint import MintProcessor, MintVideoProcessor
from tests.transformers_common import sdist

common = sdist.load("test_processing_common")


class MintProcessorTest(common.ProcessorTesterMixin, unittest.TestCase):
    processor_class = MintProcessor
    videos_input_name = "pixel_values"

    @classmethod
    def _setup_video_processor(cls) -> MintVideoProcessor:
        return MintVideoProcessor(size={"height": 28, "width": 42})

    def does_processor_return_mm_offsets(self, processor_class: type, method_name: str) -> bool:
        # The mixin looks at the first base class alone, which is one of ours.
        return getattr(processor_class, method_name) is not getattr(ProcessorMixin, method_name)

    def test_arguments_of_a_call_override_defaults(self):
        # The mixin's own checks of this need a tokenizer.
        processor, video = self.get_processor(), self.prepare_videos_inputs()
        plain = processor(videos=video, return_tensors="pt")["pixel_values"]
        assert plain.shape == (1, 8, 3, 28, 42)
        other = {"size": {"height": 14, "width": 14}}
        for arguments in (other, {"videos_kwargs": other}):
            changed = processor(videos=video, return_tensors="pt", **arguments)["pixel_values"]
            assert changed.shape == (1, 8, 3, 14, 14)
        again = processor(videos=video, return_tensors="pt")["pixel_values"]
        assert torch.equal(again, plain)
        with pytest.raises(ValueError, match="size"):
            processor(videos=video, videos_kwargs=other, **other)
