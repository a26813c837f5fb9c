"""README.md's list of skipped tests: sound in itself, and enforced."""

from tests.transformers_common import conftest, sdist
from tests.transformers_common.conftest import INAPPLICABLE, LACKING, LISTED, NEVER_SKIPPED


def test_every_row_names_tests_that_exist():
    mixins = {
        "test_modeling_common": "ModelTesterMixin",
        "test_processing_common": "ProcessorTesterMixin",
        "test_video_processing_common": "VideoProcessingTestMixin",
    }
    known = {
        name for module, mixin in mixins.items() for name in dir(getattr(sdist.load(module), mixin))
    }
    assert set(LISTED) == {INAPPLICABLE, LACKING}
    for section, patterns in LISTED.items():
        for pattern in patterns:
            assert any(conftest.matches(name, [pattern]) for name in known), (section, pattern)


def test_the_rule():
    assert conftest.fault("test_determinism", skipped=True) == "it may never be skipped"
    assert conftest.fault("test_eager_matches_sdpa_inference_00", skipped=True) is not None
    assert "does not list" in conftest.fault("test_config", skipped=True)
    assert "it ran" in conftest.fault("test_inputs_embeds", skipped=False)
    assert conftest.fault("test_inputs_embeds", skipped=True) is None
    assert conftest.fault("test_cpu_offload", skipped=True) is None
    assert conftest.fault("test_cpu_offload", skipped=False) is None


def test_what_may_never_be_skipped_is_not_listed_and_exists():
    names = dir(sdist.load("test_modeling_common").ModelTesterMixin)
    names += dir(sdist.load("test_processing_common").ProcessorTesterMixin)
    names += dir(sdist.load("test_video_processing_common").VideoProcessingTestMixin)
    for pattern in NEVER_SKIPPED:
        protected = [name for name in names if conftest.matches(name, [pattern])]
        assert protected, pattern
        for name in protected:
            assert not conftest.matches(name, LISTED[INAPPLICABLE] + LISTED[LACKING]), name
