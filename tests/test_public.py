"""The public names: importable, documented on the reference page, and with complete docstrings."""

import ast
import inspect
import re
from pathlib import Path

import pytest

import lardhm_torch

ROOT = Path(__file__).parents[1]
NAMES = lardhm_torch.__all__
FUNCTIONS = [name for name in NAMES if inspect.isfunction(getattr(lardhm_torch, name))]
SELF_DESCRIBING = ("LardHilbertMap", "Samples", "Scans", "TiledMap")  # their methods are read, too


def docstring_of(name):
    return inspect.getdoc(getattr(lardhm_torch, name)) or ""


def sections_missing(function):
    """Names of the docstring sections that a function needs and does not have."""
    signature = inspect.signature(function)
    text = inspect.getdoc(function) or ""
    tree = ast.parse(inspect.cleandoc("\n" + inspect.getsource(function)))
    needs = {
        "Args:": any(name not in ("self", "cls") for name in signature.parameters),
        "Returns:": signature.return_annotation not in ("None", None),
        "Raises:": any(isinstance(node, ast.Raise) for node in ast.walk(tree)),
    }
    if "Yields:" in text:
        needs["Returns:"] = False
    return [section for section, needed in needs.items() if needed and section not in text]


def test_the_fixed_names_are_public():
    fixed = """
        Body FitConfig LardHilbertMap MapViewer Mover PacketReceiver
        PacketSender PacketWriter Samples SamplingConfig ScanReport Scans
        StreamConfig TiledMap TuneConfig UpdateConfig body_collision_probability body_distance
        capsule_distance channel clearance collision_probability evaluate expected_range extract_mesh
        fine_tune free_probability frontiers grid information_gain iter_scans load_points load_scans
        merge_maps query_grid query_slice raycast real_time resize_optimizer resume_stream sample_rays
        save_grid save_mesh save_nav2 save_onnx save_scans scan_disagreement segment_hazard
        signed_distance simplify_mesh simulate_room split_rays stream_scans surface_distance
    """
    assert fixed.split() == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_a_public_name_imports_and_says_what_it_is(name):
    first_line = docstring_of(name).split("\n")[0]
    assert first_line.endswith((".", ":")), first_line
    assert getattr(lardhm_torch, name).__name__ == name


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'lard'"):
        _ = lardhm_torch.lard


def test_tab_completion_lists_the_public_names():
    assert dir(lardhm_torch) == NAMES


def test_editors_see_the_same_names_in_the_same_modules():
    tree = ast.parse((ROOT / "lardhm_torch" / "__init__.py").read_text())
    seen = {
        alias.name: node.module.removeprefix("lardhm_torch.")
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("lardhm_torch.")
        for alias in node.names
    }
    assert seen == lardhm_torch._MODULE_OF


def test_the_reference_page_documents_every_public_name():
    page = (ROOT / "docs" / "api.md").read_text()
    documented = re.findall(r"^\.\. auto(?:class|function):: lardhm_torch\.(\w+)$", page, re.M)
    assert sorted(documented) == NAMES


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_public_function_documents_arguments_result_and_errors(name):
    assert sections_missing(getattr(lardhm_torch, name)) == []


@pytest.mark.parametrize("name", FUNCTIONS)
def test_config_is_a_keyword_and_seed_has_a_default(name):
    parameters = inspect.signature(getattr(lardhm_torch, name)).parameters
    if "seed" in parameters:
        assert parameters["seed"].default == 0
    if "config" in parameters:
        assert parameters["config"].default is None


@pytest.mark.parametrize("name", SELF_DESCRIBING)
def test_the_methods_of_a_public_class_have_docstrings(name):
    for method, value in vars(getattr(lardhm_torch, name)).items():
        if callable(value) and not method.startswith("_"):
            assert inspect.getdoc(value), f"{name}.{method}"


def test_a_missing_section_is_found():
    def double(points):
        """Twice the points."""
        if points is None:
            raise ValueError
        return 2 * points

    assert sections_missing(double) == ["Args:", "Returns:", "Raises:"]
