"""MINT: a window of egocentric frames in, world-space camera and two-hand motion out.

Shape letters: B batch, T frames in a window, H x W image, C width, N patches of a frame,
S = 2 + registers special tokens, P = S + N tokens a frame.

Two things run over the frames: a patch encoder that sees one frame at a time (so a frame that two
windows share is encoded once, `MintModel.encode_frames`), and an aggregator that alternates between
attention within a frame and attention over the whole window. Four heads read its last pair.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor, nn
from transformers import initialization as init
from transformers.modeling_utils import PreTrainedModel
from transformers.processing_utils import Unpack
from transformers.utils import ModelOutput, TransformersKwargs
from transformers.utils.generic import can_return_tuple, merge_with_config_defaults
from transformers.utils.output_capturing import OutputRecorder, capture_outputs

from ..geometry.hand_model import HandModel
from ..geometry.hand_state import keep_in_picture
from .configuration_mint import MintConfig
from .conversion_mint import load_lingbot, register_conversion
from .crop_mint import Crops, MintHandCrops
from .heads_mint import (
    INITIAL_FOV_VH_DEG,
    INITIAL_TRUST,
    INITIAL_WRIST_M,
    MintCameraHead,
    MintFovHead,
    MintFovOutput,
    MintHandHead,
    MintPathRefinement,
    MintPresenceHead,
)
from .layers_mint import (
    MintAggregatorLayer,
    MintAttention,
    MintConvolutionalStem,
    MintEncoderLayer,
    MintFrameLayer,
    MintGlobalLayer,
    MintLayer,
    rotary_positions,
)
from .loading_mint import load_checked
from .losses_mint import (
    ATTENTION_TERM,
    RELEASE_STAGE_1,
    LossCase,
    LossSettings,
    camera_loss,
    total,
)
from .motion_mint import MintMotionCue, describe
from .saving_mint import SavesCode

IMAGE_MEAN = (0.485, 0.456, 0.406)
IMAGE_STD = (0.229, 0.224, 0.225)
SCRATCH_TOKEN_STD = 0.4
SCRATCH_HEAD_STD = 4e-4
"""Of fresh tokens and queries, and of the weights that make a head's numbers."""


@dataclass
class MintOutput(ModelOutput):
    """What `MintModel` returns for windows of T frames; hands are left first, metres, radians.

    Attributes:
        loss: scalar, when labels are given.
        losses: every term of the loss by name, unweighted, when labels are given; those of a
            camera path before pictures refined it, "unrefined/" before them.
        last_hidden_state: (B, T, P, 2C) tokens of the last frame and global layers, joined.
        pose_encoding: (B, T, 9) camera state: translation 3, quaternion xyzw 4 (not normalised),
            field of view (vertical, horizontal); world-to-camera, OpenCV axes.
        camera_iterations: translation and quaternion (B, T, 7) after each iteration, last one last;
            behind them, refined by pictures, if the configuration says so.
        hand_state: (B, T, 2, 109) camera-frame hands after the last iteration (see hand_state.py).
        initial_hand_state: (B, T, 2, 109) camera-frame hands of the first iteration.
        presence_logits: (B, T, 2), at or above 0 where a hand is in the picture.
        hidden_states: (B, T, P, C) before the aggregator's first layer and after each one, frame
            and global in turn, when asked for.
        attentions: weights of the same layers, (BT, heads, P, P) of a frame layer and
            (B, heads, TP, TP) of a global one, when asked for with eager attention.
    """

    loss: Tensor | None = None
    losses: dict[str, Tensor] | None = None
    last_hidden_state: Tensor | None = None
    pose_encoding: Tensor | None = None
    camera_iterations: tuple[Tensor, ...] | None = None
    hand_state: Tensor | None = None
    initial_hand_state: Tensor | None = None
    presence_logits: Tensor | None = None
    hidden_states: tuple[Tensor, ...] | None = None
    attentions: tuple[Tensor, ...] | None = None


def sine_positions(grid: int, width: int) -> Tensor:
    """Sines and cosines of the place on a square grid, (grid * grid, width), row by row."""
    y, x = torch.meshgrid(*(torch.linspace(-1, 1, grid),) * 2, indexing="ij")
    waves = math.pi / 2 * 2 ** torch.linspace(0, 3, width // 4)
    parts = [f(side.reshape(-1, 1) * waves) for side in (x, y) for f in (torch.sin, torch.cos)]
    return 0.5 * torch.cat(parts, 1)


class MintEncoder(nn.Module):
    """Patch encoder: a ViT with register tokens (Oquab et al. 2023; Darcet et al. 2023)."""

    def __init__(self, config: MintConfig):
        super().__init__()
        width, patch = config.hidden_size, config.patch_size
        self.grid = config.position_grid
        self.patch_embedding = (
            nn.Conv2d(3, width, patch, stride=patch)
            if config.patch_stem == "linear"
            else MintConvolutionalStem(width, patch, config.patch_stem_blocks)
        )
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.register_tokens = nn.Parameter(torch.zeros(1, config.num_register_tokens, width))
        self.position_embeddings = nn.Parameter(torch.zeros(1, 1 + self.grid**2, width))
        # In the release and in DINOv2, for masked training; kept so that checkpoints are complete.
        self.mask_token = nn.Parameter(torch.zeros(1, width), requires_grad=False)
        self.layers = nn.ModuleList(
            MintEncoderLayer(
                width,
                config.num_attention_heads,
                eps=1e-6,
                layer_scale=config.encoder_layer_scale,
                small=False,
            )
            for _ in range(config.encoder_layers)
        )
        self.norm = nn.LayerNorm(width, eps=1e-6)
        self.hand_crops = (
            MintHandCrops(width, config.hand_crop_size) if config.hand_crop_size else None
        )

    def positions(self, grid_hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """Position embedding of the cls token (1, 1, C) and of a grid of patches (1, N, C)."""
        cls, patches = self.position_embeddings.split([1, self.grid**2], 1)
        if grid_hw != (self.grid, self.grid):
            square = patches.float().unflatten(1, (self.grid, self.grid)).permute(0, 3, 1, 2)
            resized = nn.functional.interpolate(
                square, size=grid_hw, mode="bicubic", antialias=True, align_corners=False
            )
            patches = resized.flatten(2).transpose(1, 2).to(patches.dtype)
        return cls, patches

    def forward(self, frames: Tensor, implementation: str) -> tuple[Tensor, Crops | None]:
        """(F, 3, H, W) in [0, 1] -> (F, N, C), and what was seen of hands, if they are cut out."""
        mean, std = (
            torch.tensor(values, dtype=torch.float32, device=frames.device).view(3, 1, 1)
            for values in (IMAGE_MEAN, IMAGE_STD)
        )
        images = (frames - mean) / std
        patches = self.patch_embedding(images.to(self.cls_token.dtype))  # (F, C, h, w)
        cls_position, patch_positions = self.positions(tuple(patches.shape[-2:]))
        x = patches.flatten(2).transpose(1, 2) + patch_positions
        count = x.shape[0]
        specials = [
            (self.cls_token + cls_position).expand(count, -1, -1),
            self.register_tokens.expand(count, -1, -1),
        ]
        x = torch.cat([*specials, x], 1)
        for layer in self.layers:
            x = layer(x, implementation)
        x = self.norm(x)[:, 1 + self.register_tokens.shape[1] :]
        crops = None
        if self.hand_crops is not None:
            crops = self.hand_crops(images, x, tuple(patches.shape[-2:]))
        return x, crops


class MintAggregator(nn.Module):
    """Pairs of a frame layer and a global layer over patch and special tokens."""

    def __init__(self, config: MintConfig):
        super().__init__()
        width, registers = config.hidden_size, config.num_register_tokens
        self.head_dim = width // config.num_attention_heads
        # Slot 0 is for the first frame of a window, slot 1 for every later one.
        self.camera_token = nn.Parameter(torch.zeros(1, 2, 1, width))
        self.register_token = nn.Parameter(torch.zeros(1, 2, registers, width))
        self.scale_token = nn.Parameter(torch.zeros(1, 2, 1, width))
        self.hand_token = (
            nn.Parameter(torch.zeros(1, 1, config.num_hand_tokens, width))
            if config.num_hand_tokens
            else None
        )
        options = {
            "layer_scale": config.aggregator_layer_scale,
            "qk_norm": True,
            "small": False,
        }
        self.motion_cue = (
            MintMotionCue(width, config.patch_size, config.motion_radius)
            if config.motion_radius
            else None
        )
        layers, heads = range(config.aggregator_layers), config.num_attention_heads
        self.frame_layers = nn.ModuleList(MintFrameLayer(width, heads, **options) for _ in layers)
        self.global_layers = nn.ModuleList(MintGlobalLayer(width, heads, **options) for _ in layers)

    def forward(self, patches: Tensor, grid_hw: tuple[int, int], implementation: str) -> Tensor:
        """(B, T, N, token size), hands' tokens behind them if there are any -> (B, T, P, 2C)."""
        batch, frames = patches.shape[:2]
        hands, moved = None, None
        if self.hand_token is not None:
            patches, hands = patches[:, :, :-2], patches[:, :, -2:, : self.hand_token.shape[-1]]
        if self.motion_cue is not None:
            patches, moved = self.motion_cue(patches, grid_hw)
        specials = torch.cat([self.camera_token, self.register_token, self.scale_token], 2)
        first, later = specials.to(patches.dtype).split(1, 1)  # (1, 1, S, C) each
        specials = torch.cat([first, later.expand(-1, frames - 1, -1, -1)], 1)
        specials = specials.expand(batch, -1, -1, -1)
        if moved is not None:
            specials = torch.cat([specials[:, :, :1] + moved, specials[:, :, 1:]], 2)
        if hands is not None:
            specials = torch.cat([specials, hands + self.hand_token], 2)
        x = torch.cat([specials, patches], 2)  # (B, T, P, C)
        rotary = rotary_positions(grid_hw, specials.shape[2], self.head_dim, x.device)
        within = x
        for frame_layer, global_layer in zip(self.frame_layers, self.global_layers, strict=True):
            within = frame_layer(x, implementation, rotary)
            x = global_layer(within, implementation, rotary)
        return torch.cat([within, x], -1)

    def pictures(self, patches: Tensor, grid_hw: tuple[int, int]) -> Tensor:
        """What `describe` said of windows (B, T, N, token size), as pictures (B, T, 1, H, W)."""
        assert self.motion_cue is not None  # the configuration sees to it
        count, width = grid_hw[0] * grid_hw[1], self.camera_token.shape[-1]
        with torch.no_grad():
            return self.motion_cue.pictures(patches[:, :, :count, width:], grid_hw)


class MintPreTrainedModel(SavesCode, PreTrainedModel):
    """Loading, saving and initialisation shared by MINT models."""

    config: MintConfig
    base_model_prefix = "mint"
    main_input_name = "pixel_values"
    input_modalities = ("video",)
    supports_gradient_checkpointing = True
    accepts_loss_kwargs = False
    _no_split_modules = ["MintEncoderLayer", "MintFrameLayer", "MintGlobalLayer", "MintLayer"]  # noqa: RUF012
    _keep_in_fp32_modules_strict = ["camera_head"]  # noqa: RUF012
    _supports_sdpa = True
    _supports_flash_attn = True
    _supports_flex_attn = True
    _supports_attention_backend = True
    _can_compile_fullgraph = True
    _can_record_outputs = {  # noqa: RUF012
        "hidden_states": OutputRecorder(
            MintAggregatorLayer, num_hidden_layers_key="num_recorded_layers"
        ),
        "attentions": OutputRecorder(MintAttention, index=1, layer_name="aggregator"),
    }

    @classmethod
    def from_pretrained(  # type: ignore[override]
        cls, pretrained_model_name_or_path: str | Path | None, *args: Any, **kwargs: Any
    ) -> Self:
        """Load a folder or hub repository under our tensor names or the public release's.

        Everything `PreTrainedModel.from_pretrained` takes, and:

        Args:
            pretrained_model_name_or_path: a folder or repository with `model.safetensors`; without
                a `config.json` of ours it must have the release's shapes, or `config=` is needed.
            strict: (keyword, default True) refuse missing, unexpected or misshapen tensors, listing
                them; False loads what fits and lists the rest in a warning.

        Raises:
            ValueError: tensors that do not fit the configuration, or that hold NaN or infinity.
        """
        return load_checked(
            cls, super().from_pretrained, pretrained_model_name_or_path, *args, **kwargs
        )

    def save_pretrained(
        self, save_directory: str | PathLike[str], *args: Any, **kwargs: Any
    ) -> None:
        """Save as `PreTrainedModel.save_pretrained` does, under our tensor names unless asked.

        With ``remote_code=True`` the code comes along, see `SavesCode`.
        """
        kwargs.setdefault("save_original_format", False)
        super().save_pretrained(save_directory, *args, **kwargs)

    @torch.no_grad()
    def _init_weights(self, module: nn.Module) -> None:
        scratch = self.config.initializer == "scratch"
        std = SCRATCH_TOKEN_STD if scratch else self.config.initializer_range
        if isinstance(module, MintFovOutput):
            init.normal_(module.weight, std=SCRATCH_HEAD_STD if scratch else 0.02)
            fov = torch.tensor([math.radians(degrees) for degrees in INITIAL_FOV_VH_DEG])
            init.copy_(module.bias, torch.log(torch.expm1(fov - 1e-4)))  # undo the softplus
        elif isinstance(module, nn.Linear | nn.Conv2d):
            fan_in = module.weight[0].numel()
            init.trunc_normal_(module.weight, std=fan_in**-0.5 if scratch else std)
            if module.bias is not None:
                init.zeros_(module.bias)
        elif isinstance(module, nn.LayerNorm):
            init.ones_(module.weight)
            init.zeros_(module.bias)
        elif isinstance(module, MintLayer) and module.initial_layer_scale is not None:
            init.constant_(module.layer_scale1, module.initial_layer_scale)
            init.constant_(module.layer_scale2, module.initial_layer_scale)
        elif isinstance(module, MintEncoder):
            for parameter in (module.cls_token, module.register_tokens):
                init.normal_(parameter, std=std if scratch else 1e-6)
            init.trunc_normal_(module.position_embeddings, std=std)
            if scratch:
                patches = sine_positions(module.grid, module.position_embeddings.shape[-1])
                cls = module.position_embeddings[:, :1]
                init.copy_(module.position_embeddings, torch.cat([cls, patches[None]], 1))
            init.zeros_(module.mask_token)
        elif isinstance(module, MintAggregator):
            for parameter in module.parameters(recurse=False):
                init.normal_(parameter, std=std if scratch else 1e-6)
        else:
            self._init_head(module, std)

    def _init_refinement(self, module: MintPathRefinement) -> None:
        """All patches are trusted alike, and the path as much as `BELIEF` says."""
        init.zeros_(module.belief.weight)
        init.zeros_(module.belief.bias)
        init.zeros_(module.trust.fc2.weight)
        init.constant_(module.trust.fc2.bias, INITIAL_TRUST)

    def _init_head(self, module: nn.Module, std: float) -> None:
        """Heads start near a sensible answer: identity rotations, no motion, no increments.

        Called after the head's linear layers were initialised (children come first), and only for
        modules that hold parameters of their own.
        """
        scratch = self.config.initializer == "scratch"
        if isinstance(module, MintCameraHead):
            init.zeros_(module.empty_pose)
            if scratch:
                init.normal_(module.pose_mlp.fc2.weight, std=SCRATCH_HEAD_STD)
            bias = torch.zeros(7)
            # The iterations add up to w = 1.
            bias[6] = 1.0 / (module.iterations * module.output_scale)
            init.copy_(module.pose_mlp.fc2.bias, bias)
            if module.refinement is not None:
                self._init_refinement(module.refinement)
        elif isinstance(module, MintHandHead):
            init.normal_(module.queries, std=std)
            init.zeros_(module.empty_state)
            identity = torch.tensor([1.0, 0, 0, 0, 1, 0])
            for name, joints in (("orientation", 1), ("pose", 15)):
                init.copy_(module.absolute_heads[name].bias, identity.repeat(joints))
            init.copy_(module.absolute_heads["translation"].bias, torch.tensor(INITIAL_WRIST_M))
            if scratch:
                for head in module.absolute_heads.values():
                    init.normal_(head.weight, std=SCRATCH_HEAD_STD)
            for head in module.increment_heads.values():
                init.zeros_(head.weight)
                init.zeros_(head.bias)
        elif isinstance(module, MintPresenceHead):
            init.normal_(module.queries, std=std)
            if scratch:
                init.normal_(module.classifier.weight, std=SCRATCH_HEAD_STD)


class MintModel(MintPreTrainedModel):
    """The whole network: patch encoder, aggregator, camera, fov, hand and presence heads.

    Attributes:
        loss_settings: which terms the loss has when labels are given; the release's first stage.
        loss_hand_model: turns hands into keypoints for the loss; None: its shape space's default.
    """

    def __init__(self, config: MintConfig):
        super().__init__(config)
        self.loss_settings = LossSettings(RELEASE_STAGE_1)
        self.loss_hand_model: HandModel | None = None
        self.encoder = MintEncoder(config)
        self.aggregator = MintAggregator(config)
        self.camera_head = MintCameraHead(config)
        self.fov_head = MintFovHead(config)
        self.hand_head = MintHandHead(config)
        self.presence_head = MintPresenceHead(config)
        self.post_init()

    @classmethod
    def from_lingbot_map(cls, path: str | Path, config: MintConfig | None = None) -> Self:
        """A fresh model whose encoder and aggregator come from `lingbot-map.pt`, as stage 1 starts.

        Args:
            path: the checkpoint, a torch pickle that is read with weights_only=True.
            config: its sizes; the full model's by default.

        Raises:
            ValueError: the checkpoint lacks a tensor of the encoder or aggregator.
        """
        model = cls(config or MintConfig.full())
        load_lingbot(model, path)
        return model

    def refine_by_pictures(self) -> None:
        """From here on, make the camera head's path exact by pictures (`camera_refinement`).

        Raises:
            ValueError: a network whose patch tokens do not carry pixels: its motion_radius is 0.
        """
        if self.camera_head.refinement is not None:
            return
        if not self.config.motion_radius:
            raise ValueError(
                "camera refinement: expected a network with a motion_radius of at least 1, got 0"
            )
        self.config.camera_refinement = "pictures"
        width, patch = 2 * self.config.hidden_size, self.config.patch_size
        refinement = MintPathRefinement(width, patch).to(self.device)
        for module in refinement.modules():
            self._init_weights(module)
        self._init_refinement(refinement)
        self.camera_head.refinement = refinement

    def leave_path_unrefined(self) -> None:
        """From here on, say the camera head's own path; what was learned of refining it is lost."""
        self.config.camera_refinement = "none"
        self.camera_head.refinement = None

    def get_input_embeddings(self) -> nn.Module:
        """The convolution that embeds patches."""
        return self.encoder.patch_embedding

    def set_input_embeddings(self, value: nn.Module) -> None:
        """Replace the convolution that embeds patches."""
        self.encoder.patch_embedding = value

    def encode_frames(self, pixel_values: Tensor) -> Tensor:
        """Patch tokens of frames, each seen alone: (..., 3, H, W) in [0, 1] -> (..., N, C).

        With a motion cue, what `describe` says of each patch follows its C numbers; with hand
        crops, the left and the right hand's token follow the N patches.
        """
        return self._encode(pixel_values)[0]

    def _encode(self, pixel_values: Tensor) -> tuple[Tensor, Tensor | None]:
        """Tokens as of `encode_frames`, and where hands were looked for, (..., 2, N)."""
        self._check_pixels(pixel_values)
        leading, frames = pixel_values.shape[:-3], pixel_values.flatten(0, -4)
        tokens, crops = self.encoder(frames, self.config._attn_implementation)
        if self.config.motion_radius:
            described = describe(frames, self.config.patch_size)
            tokens = torch.cat([tokens, described.to(tokens.dtype)], -1)
        if crops is None:
            return tokens.unflatten(0, leading), None
        hands = nn.functional.pad(crops.tokens, (0, tokens.shape[-1] - crops.tokens.shape[-1]))
        tokens = torch.cat([tokens, hands.to(tokens.dtype)], 1)
        return tokens.unflatten(0, leading), crops.where.unflatten(0, leading)

    @merge_with_config_defaults
    @capture_outputs(tie_last_hidden_states=False)
    @can_return_tuple
    def forward(
        self,
        pixel_values: Tensor | None = None,
        patch_tokens: Tensor | None = None,
        grid_hw: tuple[int, int] | None = None,
        labels: Mapping[str, Tensor] | None = None,
        known_fov_vh: Tensor | None = None,
        **kwargs: Unpack[TransformersKwargs],
    ) -> MintOutput:
        """Run windows of frames, given as pixels or as patch tokens from `encode_frames`.

        Args:
            pixel_values: (B, T, 3, H, W) RGB in [0, 1]; H and W multiples of the patch size.
            patch_tokens: (B, T, N, token size), instead of pixel_values: what `encode_frames` gave.
            grid_hw: rows and columns of patches, with patch_tokens; the configuration's by default.
            labels: the truth, by name (`LossCase`): ``pose_encoding`` (B, T, 9) relative to the
                first frame, ``hand_state`` (B, T, 2, 109), ``presence`` (B, T, 2), and optional
                ones.
            known_fov_vh: (B, 2) radians, vertical and horizontal, where the lens is known: the
                camera's path is refined under it (`camera_refinement`; without, nothing changes).
                What comes out as field of view stays the network's own: hands lie under that.

        Returns:
            MintOutput: see its attributes. The world is the camera of the window's first frame, as
            far as the network has learnt it (frame 0 comes out near the identity, not exactly).

        Raises:
            ValueError: neither or both inputs, shapes that do not fit the configuration, or labels
                that lack something or hold NaN.
        """
        if (pixel_values is None) == (patch_tokens is None):
            raise ValueError(
                "expected exactly one of pixel_values (B, T, 3, H, W) and patch_tokens"
            )
        implementation, where = self.config._attn_implementation, None
        if patch_tokens is None:
            if pixel_values.ndim != 5:
                raise ValueError(
                    f"pixel_values: expected (B, T, 3, H, W), got {tuple(pixel_values.shape)}"
                )
            patch = self.config.patch_size
            patch_tokens, where = self._encode(pixel_values)
            grid_hw = (pixel_values.shape[-2] // patch, pixel_values.shape[-1] // patch)
        else:
            grid_hw = tuple(grid_hw or self.config.grid_hw)
            count = grid_hw[0] * grid_hw[1] + self.config.num_hand_tokens
            expected = (count, self.config.token_size)
            if patch_tokens.ndim != 4 or tuple(patch_tokens.shape[-2:]) != expected:
                raise ValueError(
                    f"patch_tokens: expected (B, T, {expected[0]}, {expected[1]}) for a grid of "
                    f"{grid_hw}, got {tuple(patch_tokens.shape)}"
                )
        if known_fov_vh is not None:
            self._check_known_fov(known_fov_vh, len(patch_tokens))
        tokens = self.aggregator(patch_tokens, grid_hw, implementation)
        camera_tokens = tokens[:, :, 0]
        poses = self.camera_head(camera_tokens, implementation)
        fov = self.fov_head(camera_tokens, implementation)
        fov_before = None
        if self.camera_head.refinement is not None:
            pictures = self.aggregator.pictures(patch_tokens, grid_hw)
            seen = torch.cat([tokens[:, :, :1], tokens[:, :, self.config.num_special_tokens :]], 2)
            refined, lens = self.camera_head.refinement(
                poses[-1], fov, seen, pictures, known_fov_vh
            )
            poses, fov_before, fov = (*poses, refined), fov, lens[:, None].expand_as(fov)
        wanted = labels is not None and self.loss_settings.weights.get(ATTENTION_TERM, 0) > 0
        looks: list[Tensor] | None = [] if wanted else None
        hands = self.hand_head(tokens, implementation, looks)
        if fov_before is not None:
            hands = tuple(keep_in_picture(hand, fov_before, fov) for hand in hands)
        presence = self.presence_head(
            tokens[:, :, self.config.num_special_tokens :], implementation, looks
        )
        output = MintOutput(
            last_hidden_state=tokens,
            pose_encoding=torch.cat([poses[-1], fov.to(poses[-1].dtype)], -1),
            camera_iterations=poses,
            hand_state=hands[-1],
            initial_hand_state=hands[0],
            presence_logits=presence,
        )
        if labels is not None:
            case = self._loss_case(output, labels, grid_hw, looks, where)
            output.loss, output.losses = total(case)
            if self.camera_head.refinement is not None:  # what is refined learns by its own errors
                believed = torch.cat([poses[-2], output.pose_encoding[..., 7:]], -1)
                own, terms = camera_loss(case, believed)
                output.loss = output.loss + own
                output.losses |= {f"unrefined/{name}": term for name, term in terms.items()}
        return output

    def _loss_case(
        self,
        output: MintOutput,
        labels: Mapping[str, Tensor],
        grid_hw: tuple[int, int],
        looks: list[Tensor] | None,
        where: Tensor | None,
    ) -> LossCase:
        patch = self.config.patch_size
        prediction = {n: output[n] for n in ("pose_encoding", "hand_state", "presence_logits")}
        if looks is not None:  # (BT, 8 or 2, P or N) each -> (BT, 2, 4 or 1, N) -> (B, T, 2, Q, N)
            count = grid_hw[0] * grid_hw[1]
            looks = [look[..., -count:].unflatten(1, (2, -1)) for look in looks]
            frames = output.presence_logits.shape[:2]
            looked = torch.cat(looks, 2).unflatten(0, frames)
            if where is not None:
                looked = torch.cat([looked, where[..., None, :]], -2)
            prediction["patch_attention"] = looked
        return LossCase(
            prediction,
            labels,
            self.loss_settings,
            image_size_hw=(grid_hw[0] * patch, grid_hw[1] * patch),
            grid_hw=grid_hw,
            shape_space=self.config.shape_space,
            hand_model=self.loss_hand_model,
        )

    @staticmethod
    def _check_known_fov(known_fov_vh: Tensor, windows: int) -> None:
        if tuple(known_fov_vh.shape) != (windows, 2):
            raise ValueError(
                f"known_fov_vh: expected ({windows}, 2), vertical and horizontal of each window, "
                f"got {tuple(known_fov_vh.shape)}"
            )
        if not ((known_fov_vh > 0) & (known_fov_vh < math.pi)).all():
            raise ValueError(
                f"known_fov_vh: expected radians between 0 and pi, got {known_fov_vh.tolist()}"
            )

    def _check_pixels(self, pixel_values: Tensor) -> None:
        patch = self.config.patch_size
        shape = tuple(pixel_values.shape)
        if len(shape) < 4 or shape[-3] != 3:
            raise ValueError(f"pixel_values: expected (..., 3, H, W), got {shape}")
        if shape[-2] % patch or shape[-1] % patch or not shape[-2] or not shape[-1]:
            raise ValueError(
                f"pixel_values: expected height and width that are multiples of the patch size "
                f"{patch}, got {shape[-2]} x {shape[-1]}"
            )


register_conversion(MintModel.__name__)

__all__ = ["MintModel", "MintOutput", "MintPreTrainedModel"]
