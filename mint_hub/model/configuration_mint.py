"""The sizes of a MINT network, validated by name when they are made."""

from dataclasses import fields
from typing import Any, Literal, Self

from huggingface_hub.dataclasses import strict
from transformers.configuration_utils import PreTrainedConfig

CROP_PATCH = 16
"""Side of what becomes one feature of a hand's crop, pixels."""
MAY_BE_ZERO = ("num_register_tokens", "patch_stem_blocks", "motion_radius", "hand_crop_size")


@strict
class MintConfig(PreTrainedConfig):
    """Configuration of `MintModel`; the defaults are the public release's (1.14 B parameters).

    Args:
        image_size: (height, width) of a frame as the network sees it, multiples of patch_size.
        patch_size: side of a square patch, pixels.
        patch_stem: how a patch becomes a token: "linear", as in the release, or "convolutional":
            a 3 x 3 convolution for every halving of the picture (Xiao et al. 2021), which learns
            sooner where little was learned before; patch_size must be a power of 2 then.
        patch_stem_blocks: residual blocks of two convolutions at each of the last two sizes of a
            convolutional stem.
        position_grid: side, in patches, of the square grid of the position embedding.
        hidden_size: width C of the patch encoder and of the aggregator.
        num_attention_heads: heads in the encoder, frame and global layers.
        encoder_layers: depth of the patch encoder.
        aggregator_layers: pairs of one frame layer and one global layer.
        num_register_tokens: register tokens, in the encoder and again in the aggregator.
        motion_radius: largest shift, in pixels at half size, at which patches are compared with the
            frame before, as a cue of motion for small networks (`MintMotionCue`); 0, as in the
            release: patches are not compared. Needs a patch_size that is a multiple of 4.
        hand_crop_size: side, in pixels, of a square about each hand that is looked at once more,
            as small networks have patches as large as hands (`MintHandCrops`); 0, as in the
            release: there is one look. A multiple of 16.
        camera_layers: depth of the camera head's trunk, run once an iteration.
        camera_heads: attention heads of the camera head, which is 2 C wide.
        camera_iterations: refinement iterations of the camera head.
        camera_relative_to: what the camera head's numbers of a frame mean: its pose relative to the
            window's "first" frame, as in the release, or its motion since the "previous" one, which
            are chained into poses: small networks then need not add up a window's motion.
        camera_refinement: what becomes of the camera head's path: "none", as in the release, or
            "pictures": it is made exact by laying the window's pictures over each other
            (`refine_path`), as small networks learn geometry badly. Needs a motion_radius.
        camera_output_scale: what the camera head's last layer is multiplied by. A camera moves by
            millimetres a frame: below 1, steps of training are as fine, and its gradients do not
            drown the hands' in what both share, where nothing was learned before.
        fov_hidden_size: width of the field-of-view head.
        fov_heads: attention heads of the field-of-view head.
        fov_layers: depth of the field-of-view head.
        hand_hidden_size: width of the hand head.
        hand_heads: attention heads of the hand head.
        hand_layers: self-attention layers over the eight hand queries.
        hand_iterations: iterations of the hand head; the first is absolute, later ones increments.
        presence_hidden_size: width of the presence head.
        presence_heads: attention heads of the presence head.
        window: frames the network was trained to see at once.
        shape_space: what the ten shape numbers mean, "mano" or "mint" (the licence-free hand).
        encoder_layer_scale: initial LayerScale of the patch encoder.
        aggregator_layer_scale: initial LayerScale of the aggregator and of the camera head.
        initializer: how fresh weights are drawn: "release", every linear layer alike, as where most
            of them are replaced by pretrained ones; or "scratch", for networks that begin from
            nothing: layers keep the size of what goes through them (LeCun et al. 1998), positions
            are visible from the start (sine and cosine, Vaswani et al. 2017), and heads start at
            their mean answer, so that fitting it does not wash out the features.
        initializer_range: standard deviation of fresh linear weights under "release".

    Raises:
        ValueError: (when made) a size that does not divide what it must, naming the field.
    """

    model_type = "mint"
    attribute_map = {"num_hidden_layers": "aggregator_layers"}  # noqa: RUF012 (transformers' way)

    image_size: list[int] | tuple[int, int] = (378, 518)
    patch_size: int = 14
    patch_stem: Literal["linear", "convolutional"] = "linear"
    patch_stem_blocks: int = 0
    position_grid: int = 37
    hidden_size: int = 1024
    num_attention_heads: int = 16
    encoder_layers: int = 24
    aggregator_layers: int = 24
    num_register_tokens: int = 4
    motion_radius: int = 0
    hand_crop_size: int = 0
    camera_layers: int = 4
    camera_heads: int = 16
    camera_iterations: int = 4
    camera_relative_to: Literal["first", "previous"] = "first"
    camera_refinement: Literal["none", "pictures"] = "none"
    camera_output_scale: float = 1.0
    fov_hidden_size: int = 512
    fov_heads: int = 8
    fov_layers: int = 2
    hand_hidden_size: int = 512
    hand_heads: int = 8
    hand_layers: int = 1
    hand_iterations: int = 2
    presence_hidden_size: int = 256
    presence_heads: int = 4
    window: int = 32
    shape_space: Literal["mano", "mint"] = "mano"
    encoder_layer_scale: float = 1.0
    aggregator_layer_scale: float = 0.01
    initializer: Literal["release", "scratch"] = "release"
    initializer_range: float = 0.02

    def __post_init__(self, **kwargs: Any) -> None:
        self.image_size = list(self.image_size)
        if __name__.startswith("mint_hub."):
            # A repository may carry a copy of the code; where the package runs, none refers to it.
            for name in ("auto_map", "custom_pipelines"):
                kwargs.pop(name, None)
        super().__post_init__(**kwargs)

    def validate_architecture(self) -> None:
        """Check that sizes fit each other (called by transformers when a configuration is made)."""
        for name, value in self.to_dict().items():
            least = 0 if name in MAY_BE_ZERO else 1
            if name in self._counts() and value < least:
                raise ValueError(f"{name}: expected at least {least}, got {value}")
        if len(self.image_size) != 2:
            raise ValueError(f"image_size: expected (height, width), got {self.image_size}")
        for name in ("height", "width"):
            side = self.image_size[name == "width"]
            if side <= 0 or side % self.patch_size:
                raise ValueError(
                    f"image_size: expected a {name} that is a positive multiple of "
                    f"patch_size={self.patch_size}, got {side}"
                )
        if self.patch_stem == "convolutional" and (
            self.patch_size < 2 or self.patch_size & (self.patch_size - 1)
        ):
            raise ValueError(
                "patch_size: expected a power of 2, at least 2, under a convolutional patch_stem, "
                f"got {self.patch_size}"
            )
        if self.motion_radius and self.patch_size % 4:
            raise ValueError(
                f"patch_size: expected a multiple of 4 with a motion_radius, got {self.patch_size}"
            )
        if self.hand_crop_size % CROP_PATCH:
            raise ValueError(
                f"hand_crop_size: expected a multiple of {CROP_PATCH}, got {self.hand_crop_size}"
            )
        for width, heads, factor in (
            ("hidden_size", "num_attention_heads", 4),
            ("fov_hidden_size", "fov_heads", 1),
            ("hand_hidden_size", "hand_heads", 1),
            ("presence_hidden_size", "presence_heads", 1),
        ):
            unit = getattr(self, heads) * factor
            if unit <= 0 or getattr(self, width) % unit:
                extra = " (x4: rotary positions split a head in four)" if factor == 4 else ""
                raise ValueError(
                    f"{width}: expected a multiple of {heads}={getattr(self, heads)}{extra}, "
                    f"got {getattr(self, width)}"
                )
        if self.camera_refinement == "pictures" and not self.motion_radius:
            raise ValueError(
                'motion_radius: expected at least 1 with camera_refinement "pictures", got 0'
            )
        if not self.camera_output_scale > 0:
            raise ValueError(
                f"camera_output_scale: expected more than 0, got {self.camera_output_scale}"
            )
        if self.camera_heads <= 0 or 2 * self.hidden_size % self.camera_heads:
            raise ValueError(
                f"camera_heads: expected a divisor of 2 * hidden_size={2 * self.hidden_size}, "
                f"got {self.camera_heads}"
            )

    @classmethod
    def _counts(cls) -> set[str]:
        """Names of the fields that are whole numbers."""
        return {f.name for f in fields(MintConfig) if f.type in (int, "int")} & set(
            MintConfig.__annotations__
        )

    @property
    def grid_hw(self) -> tuple[int, int]:
        """Patches of a frame, (rows, columns)."""
        height, width = self.image_size
        return height // self.patch_size, width // self.patch_size

    @property
    def token_size(self) -> int:
        """Numbers of a patch token: its width, and what motion is seen by, if it is."""
        return self.hidden_size + (self.patch_size**2 if self.motion_radius else 0)

    @property
    def num_hand_tokens(self) -> int:
        """Tokens that say what was seen of each hand, if they were looked at once more."""
        return 2 if self.hand_crop_size else 0

    @property
    def num_special_tokens(self) -> int:
        """Tokens before a frame's patches: one camera, the registers, one scale, the hands'."""
        return self.num_register_tokens + 2 + self.num_hand_tokens

    @property
    def num_recorded_layers(self) -> int:
        """Layers whose hidden states and attentions can be returned: both kinds of every pair."""
        return 2 * self.aggregator_layers

    @classmethod
    def full(cls, **overrides: Any) -> Self:
        """Sizes of the public release: 1.14 billion parameters, 378 x 518 pixels."""
        return cls(**overrides)

    @classmethod
    def tiny(cls, **overrides: Any) -> Self:
        """Sizes that run in real time on two CPU cores (for the default checkpoint)."""
        sizes: dict[str, Any] = {
            "image_size": (128, 160),
            "patch_size": 16,
            "patch_stem": "convolutional",
            "patch_stem_blocks": 2,
            "position_grid": 10,
            "hidden_size": 192,
            "num_attention_heads": 3,
            "encoder_layers": 2,
            "aggregator_layers": 3,
            "motion_radius": 5,
            "hand_crop_size": 48,
            "camera_layers": 2,
            "camera_heads": 6,
            "camera_relative_to": "previous",
            "camera_output_scale": 0.05,
            "fov_hidden_size": 128,
            "fov_heads": 4,
            "hand_hidden_size": 192,
            "hand_heads": 6,
            "presence_hidden_size": 96,
            "window": 16,
            "aggregator_layer_scale": 1.0,
            "initializer": "scratch",
            "shape_space": "mint",
        }
        return cls(**(sizes | overrides))


__all__ = ["MintConfig"]
