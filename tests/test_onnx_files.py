"""ONNX models, run with the reference evaluator of the onnx library."""

import numpy as np
import pytest
import torch

from lardhm_torch import LardHilbertMap, save_onnx
from lardhm_torch.io import onnx_files

onnx = pytest.importorskip("onnx", reason="onnx is not installed (extra onnx)")
pytest.importorskip("onnxscript", reason="onnxscript is not installed (extra onnx)")


def fitted(dim, origin, clusters, neighbors):
    torch.manual_seed(1)
    points = torch.rand(400, dim).double() + torch.as_tensor(origin)[:dim]
    labels = (points[:, 0] % 1 > 0.5).double()
    return LardHilbertMap(dim, num_neighbors=neighbors).fit(
        points, labels, clusters, seed=0
    ), points


def evaluate(path, points):
    from onnx.reference import ReferenceEvaluator

    with np.errstate(all="ignore"):  # points that are not finite
        (found,) = ReferenceEvaluator(str(path)).run(None, {"points": points.numpy()})
    return torch.as_tensor(found)


@pytest.mark.parametrize(
    ("dim", "origin", "clusters", "neighbors"),
    [(3, [4e5, 5e6, 100.0], 60, 8), (2, [0.0, 0.0, 0.0], 4, 8)],  # far from zero; k = all clusters
)
def test_the_model_gives_the_answers_of_the_map(tmp_path, dim, origin, clusters, neighbors):
    model, points = fitted(dim, origin, clusters, neighbors)
    save_onnx(model, tmp_path / "map.onnx")
    saved = onnx.load(tmp_path / "map.onnx")
    onnx.checker.check_model(saved)
    assert [entry.version for entry in saved.opset_import if not entry.domain] == [18]
    assert {node.domain for node in saved.graph.node} <= {""}  # nothing that other runtimes lack
    for count in (1, 57):
        with torch.no_grad():
            expected = model(points[:count])
        torch.testing.assert_close(
            evaluate(tmp_path / "map.onnx", points[:count]), expected, atol=2e-5, rtol=0
        )
    points[3, 0], points[5, 1] = np.nan, np.inf
    found = evaluate(tmp_path / "map.onnx", points[:9])
    assert found.isnan().nonzero().flatten().tolist() == [3, 5]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["map.onnx"]


def test_an_empty_map_is_refused(tmp_path):
    with pytest.raises(ValueError, match="at least one cluster"):
        save_onnx(LardHilbertMap(), tmp_path / "map.onnx")


def test_missing_libraries_name_the_extra(tmp_path, monkeypatch):
    monkeypatch.setattr(onnx_files, "LIBRARIES", ("no_such_library",))
    with pytest.raises(ImportError, match=r"no_such_library.*lardhm_torch\[onnx\]"):
        save_onnx(fitted(2, [0.0, 0.0, 0.0], 4, 2)[0], tmp_path / "map.onnx")
