"""The map in other people's loops: compilers, exporters, optimizers, averages, the recipes."""

import copy
import importlib.util
import runpy
import sys
from pathlib import Path

import pytest
import torch
from torch import nn
from torch.optim.swa_utils import AveragedModel

from lardhm_torch import LardHilbertMap, sample_rays, save_scans, simulate_room
from lardhm_torch.evaluation.held_out import evaluate

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def samples():
    return sample_rays(simulate_room(num_rays=1500, seed=0), seed=0)


@pytest.fixture
def model(samples):
    model = LardHilbertMap().double().fit(samples.points, samples.labels, num_clusters=80)
    return model.requires_grad_(True)


class LogOdds(nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, points):
        return self.model.log_odds(points)


def test_a_compiled_map_is_one_graph_with_the_same_values_and_gradients(model, samples):
    compiled = torch.compile(LogOdds(model), backend="aot_eager", fullgraph=True, dynamic=True)
    for count in (300, 40, 511):
        points = samples.points[-count:].clone().requires_grad_(True)
        answers = [compiled(points), model.log_odds(points)]
        inputs = [points, *model.parameters()]
        slopes = [torch.autograd.grad(answer.square().sum(), inputs) for answer in answers]
        torch.testing.assert_close(*answers)
        torch.testing.assert_close(*slopes)


def test_a_compiled_map_follows_its_parameters(model, samples):
    compiled = torch.compile(LogOdds(model), backend="aot_eager", fullgraph=True)
    points = samples.points[:200]
    compiled(points)
    with torch.no_grad():
        model.centers += 0.05  # the index the graph was traced with is stale now
        model.weights *= 2
    torch.testing.assert_close(compiled(points), model.log_odds(points))


def test_an_exported_map_answers_any_number_of_points(model, samples, tmp_path):
    count = torch.export.Dim("count", min=1)
    program = torch.export.export(model, (samples.points[:64],), dynamic_shapes=({0: count},))
    torch.export.save(program, tmp_path / "map.pt2")
    loaded = torch.export.load(tmp_path / "map.pt2").module()
    for number in (1, 7, 1000):
        points = samples.points[:number]
        torch.testing.assert_close(loaded(points), model(points))


@pytest.mark.parametrize("optimizer_of", [torch.optim.SGD, torch.optim.AdamW, torch.optim.RMSprop])
def test_any_optimizer_with_clipped_gradients_lowers_the_loss(model, samples, optimizer_of):
    optimizer = optimizer_of(model.parameter_groups(weight_decay=1e-3), lr=1e-3)
    labels = samples.labels.double()
    loss_of = nn.BCEWithLogitsLoss()
    losses = []
    for _ in range(20):
        loss = loss_of(model.log_odds(samples.points), labels)
        optimizer.zero_grad()
        loss.backward()
        assert nn.utils.clip_grad_norm_(model.parameters(), max_norm=1.0).isfinite()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < losses[0]


def test_weight_decay_pulls_weights_and_nothing_else(model):
    before = copy.deepcopy(model)
    optimizer = torch.optim.SGD(model.parameter_groups(weight_decay=0.5), lr=0.1)
    for parameter in model.parameters():
        parameter.grad = torch.zeros_like(parameter)
    optimizer.step()
    torch.testing.assert_close(model.weights, 0.95 * before.weights)
    assert torch.equal(model.centers, before.centers)
    assert torch.equal(model.raw_scale_tril, before.raw_scale_tril)


def test_an_average_of_maps_is_a_map(model, samples):
    average = AveragedModel(model)
    average.update_parameters(model)
    with torch.no_grad():
        model.weights += 1
    average.update_parameters(model)
    torch.testing.assert_close(average.module.weights, model.weights - 0.5)
    expected = copy.deepcopy(model)
    with torch.no_grad():
        expected.weights -= 0.5
    torch.testing.assert_close(average(samples.points), expected(samples.points))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
def test_a_cast_map_answers_nearly_the_same(model, samples, dtype):
    points = samples.points[:500]
    cast = copy.deepcopy(model).to(dtype)
    assert cast(points).dtype == dtype
    tolerance = 1e-4 if dtype == torch.float32 else 0.2  # half: centers are rounded to centimeters
    assert (cast(points).double() - model(points)).abs().mean() < tolerance


@pytest.mark.skipif(importlib.util.find_spec("lightning") is None, reason="lightning is missing")
@pytest.mark.filterwarnings("ignore")  # its own
def test_a_lightning_module_trains_the_map(model, samples, tmp_path):
    import lightning

    class Mapper(lightning.LightningModule):
        def __init__(self):
            super().__init__()
            self.map = model

        def training_step(self, batch, _):
            points, labels = batch
            logits = self.map.log_odds(points)
            return nn.functional.binary_cross_entropy_with_logits(logits, labels.double())

        def configure_optimizers(self):
            return torch.optim.Adam(self.map.parameter_groups(), lr=1e-3)

    pairs = torch.utils.data.TensorDataset(samples.points, samples.labels)
    loader = torch.utils.data.DataLoader(pairs, batch_size=1024)
    before = model.centers.detach().clone()
    trainer = lightning.Trainer(
        max_epochs=1, accelerator="cpu", logger=False, enable_progress_bar=False,
        enable_checkpointing=False, enable_model_summary=False, default_root_dir=tmp_path,
    )  # fmt: skip
    trainer.fit(Mapper(), loader)
    assert not torch.equal(model.centers, before)


@pytest.fixture
def run(monkeypatch, capsys):
    def run_script(name, *arguments):
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        runpy.run_path(str(ROOT / "scripts" / name), run_name="__main__")
        return capsys.readouterr().out

    return run_script


def test_the_plain_torch_recipe_trains_goes_on_and_saves_a_map(run, tmp_path):
    scans = simulate_room(num_rays=1500, seed=0)
    save_scans(scans, tmp_path / "room.npz")
    given = (tmp_path / "room.npz", "-o", tmp_path / "map.pt", "--batch", 1024)
    kept = ("--checkpoint", tmp_path / "run.pt")
    assert "epoch 2" in run("train_torch.py", *given, "--epochs", 2, *kept)
    again = run("train_torch.py", *given, "--epochs", 2, *kept)
    assert "epoch" not in again  # nothing is left to train
    scores = evaluate(LardHilbertMap.load(tmp_path / "map.pt"), simulate_room(1500, seed=1))
    assert scores["unif"]["balanced_accuracy"] > 0.9


def test_the_tuning_recipe_moves_the_length_scales_of_a_saved_map_only(run, tmp_path, samples):
    save_scans(simulate_room(num_rays=1500, seed=0), tmp_path / "room.npz")
    before = LardHilbertMap().fit(samples.points, samples.labels, num_clusters=80)
    before.save(tmp_path / "map.pt")
    files = (tmp_path / "map.pt", tmp_path / "room.npz", "-o", tmp_path / "tuned.pt")
    assert "log-loss" in run("finetune.py", *files, "--epochs", 2)
    after = LardHilbertMap.load(tmp_path / "tuned.pt")
    assert torch.equal(after.weights, before.weights)
    assert torch.equal(after.centers, before.centers)
    assert not torch.equal(after.raw_scale_tril, before.raw_scale_tril)
