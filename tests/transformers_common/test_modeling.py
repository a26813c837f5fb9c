"""MintModel under the common model tests of transformers."""

import functools
import unittest
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import torch
from torch import nn

from mint_hub.model.configuration_mint import MintConfig
from mint_hub.model.modeling_mint import MintModel
from tests.transformers_common import sdist
from tests.transformers_common.tiny import tiny_config, tiny_input, tiny_labels

configuration = sdist.load("test_configuration_common")
common = sdist.load("test_modeling_common")


class MintModelTester:
    """What the mixin asks about the network."""

    batch_size = 2
    hidden_size = 32
    num_attention_heads = 2
    num_hidden_layers = 2  # one frame layer, one global layer
    seq_length = 6 + 2 * 3  # tokens of a frame
    is_training = True

    def get_config(self) -> MintConfig:
        return tiny_config()

    def prepare_config_and_inputs_for_common(self) -> tuple[MintConfig, dict[str, torch.Tensor]]:
        config = tiny_config()
        return config, {"pixel_values": tiny_input(config)}


@contextmanager
def by_default(method: str, **defaults: Any) -> Iterator[None]:
    """Give a method of MintModel other defaults than its own."""
    own = getattr(MintModel, method)
    if method == "from_pretrained":
        changed: Any = functools.partial(own, **defaults)
    else:

        def changed(self, *args, **kwargs):
            return own(self, *args, **(defaults | kwargs))

    with mock.patch.object(MintModel, method, changed):
        yield


class MintModelTest(common.ModelTesterMixin, unittest.TestCase):
    all_model_classes = (MintModel,)
    test_resize_embeddings = False  # there is no vocabulary
    test_can_init_all_missing_weights_before_2023 = True  # the year is read off a header we lack

    def setUp(self) -> None:
        self.model_tester = MintModelTester()
        self.config_tester = configuration.ConfigTester(
            self, config_class=MintConfig, has_text_modality=False, hidden_size=64
        )

    def test_config(self):
        self.config_tester.run_common_tests()

    def _prepare_for_class(self, inputs_dict, model_class, return_labels=False):
        inputs = super()._prepare_for_class(inputs_dict, model_class)
        if return_labels:
            inputs["labels"] = tiny_labels(*inputs["pixel_values"].shape[:2])
        return inputs

    def test_model_get_set_embeddings(self):
        # The mixin expects a vocabulary; ours is the convolution that embeds patches.
        model = MintModel(self.model_tester.get_config())
        assert isinstance(model.get_input_embeddings(), nn.Conv2d)
        other = nn.Conv2d(3, model.config.hidden_size, 14, 14)
        model.set_input_embeddings(other)
        assert model.get_input_embeddings() is model.encoder.patch_embedding is other
        assert model.get_output_embeddings() is None

    def test_model_weights_reload_no_missing_tied_weights(self):
        # The mixin loads a file without weights, which ours refuses unless told not to.
        with by_default("from_pretrained", strict=False):
            super().test_model_weights_reload_no_missing_tied_weights()

    def test_reverse_loading_mapping(self):
        # The mixin expects foreign names in saved files; ours writes them only when asked.
        with by_default("save_pretrained", save_original_format=True):
            super().test_reverse_loading_mapping()
