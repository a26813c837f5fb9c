"""`import mint_hub` registers its classes in transformers, in whatever order the two are imported.

Every order needs an interpreter that has not imported transformers. One subprocess imports what
both need, and forks a child for each order.
"""

import json
import multiprocessing
import os
import subprocess
import sys
import traceback
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ORDERS = {
    "mint_hub first": "mint_hub transformers.pipelines",
    "transformers first": "transformers.models.auto.modeling_auto transformers.pipelines mint_hub",
    "then modeling_layers": "mint_hub transformers.modeling_layers",
    "then processing_utils": "mint_hub transformers.processing_utils",
    "then video_processing_utils": "mint_hub transformers.video_processing_utils",
    "then another model": "mint_hub transformers.models.bert.modeling_bert",
}
# What no order is about, imported once before the children are forked.
SHARED = (
    "av cv2 datasets huggingface_hub numpy safetensors scipy.optimize torch torch._dynamo "
    "torch.distributed.tensor torch.nn.attention.flex_attention"
)


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory) -> dict[str, str]:
    """What went wrong in each order, "" where nothing did."""
    if not hasattr(os, "fork"):
        pytest.skip("needs os.fork")
    from mint_hub import MintProcessor
    from tests.small_model import small_model

    folder = tmp_path_factory.mktemp("model")
    model = small_model()
    model.save_pretrained(folder)
    MintProcessor.for_config(model.config).save_pretrained(folder)
    done = subprocess.run(
        [sys.executable, __file__, str(folder)],
        env=os.environ | {"PYTHONPATH": str(ROOT), "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"},
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("order", ORDERS)
def test_every_import_order_registers_every_class(outcomes, order):
    assert outcomes[order] == ""


def test_importing_mint_hub_imports_no_framework():
    code = (
        "import sys, mint_hub\n"
        "mint_hub.__version__, dir(mint_hub)\n"
        "assert not {'torch', 'transformers', 'numpy', 'cv2', 'av'} & sys.modules.keys()"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True, timeout=60)


def test_registering_twice_changes_nothing():
    from transformers.pipelines import PIPELINE_REGISTRY

    from mint_hub.inference.pipeline_mint import EgocentricHandsPipeline
    from mint_hub.registration import register

    register()
    register()
    task = PIPELINE_REGISTRY.check_task("egocentric-hands")[1]
    assert task["impl"] is EgocentricHandsPipeline


def check_order(order: str) -> str:
    """Import in an order, then use every registered class; in a process of its own."""
    try:
        for module in ORDERS[order].split():
            import_module(module)
        _use_every_class(sys.argv[1])
    except Exception:
        return traceback.format_exc()
    return ""


def _use_every_class(folder: str) -> None:
    import transformers
    from transformers.models.auto.video_processing_auto import AutoVideoProcessor
    from transformers.pipelines import PIPELINE_REGISTRY

    import mint_hub
    from mint_hub.inference.pipeline_mint import EgocentricHandsPipeline

    loaded = {
        "MintConfig": transformers.AutoConfig.from_pretrained(folder),
        "MintModel": transformers.AutoModel.from_pretrained(folder),
        "MintProcessor": transformers.AutoProcessor.from_pretrained(folder),
        "MintVideoProcessor": AutoVideoProcessor.from_pretrained(folder),
    }
    for name, value in loaded.items():
        assert type(value) is getattr(mint_hub, name), (name, type(value))
    assert type(transformers.AutoModel.from_config(loaded["MintConfig"])) is mint_hub.MintModel
    assert type(loaded["MintProcessor"].video_processor) is mint_hub.MintVideoProcessor
    pipe = transformers.pipeline("egocentric-hands", model=folder)
    assert type(pipe) is EgocentricHandsPipeline
    assert type(pipe.processor) is mint_hub.MintProcessor
    assert "egocentric-hands" in PIPELINE_REGISTRY.get_supported_tasks()
    import_module("transformers.models.bert.modeling_bert")
    bert = transformers.BertConfig(hidden_size=8, num_attention_heads=1, num_hidden_layers=1)
    assert type(transformers.AutoModel.from_config(bert)).__name__ == "BertModel"


if __name__ == "__main__":
    for module in SHARED.split():
        import_module(module)
    assert "transformers" not in sys.modules
    processes = multiprocessing.get_context("fork").Pool(2, maxtasksperchild=1)
    with processes:
        results = processes.map(check_order, ORDERS, chunksize=1)
    print(json.dumps(dict(zip(ORDERS, results, strict=True))))  # noqa: T201
