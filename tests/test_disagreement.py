"""How far scans disagree, and maps whose surfaces are as thick as that."""

import pytest
import torch
from command_runs import fails, run

from lardhm_torch import (
    FitConfig,
    LardHilbertMap,
    SamplingConfig,
    Scans,
    TuneConfig,
    UpdateConfig,
    fine_tune,
    load_scans,
    sample_rays,
    save_scans,
    scan_disagreement,
    simulate_room,
)
from lardhm_torch.learning.points import blurred_hits


def moved_room(distance, num_rays=24_000, seed=0):
    """Two scans of a room, the second moved this far along each axis [m]."""
    scans = simulate_room(num_rays=num_rays, seed=seed)
    scans = scans.select(scans.scan_id < 2)
    moves = distance * torch.arange(3, dtype=torch.float64)[:, None]
    ends = scans.ends + moves[scans.scan_id]
    return Scans(scans.origins + moves, ends, scans.scan_id, scans.is_return)


@pytest.mark.parametrize("distance", [0.02, 0.05])
def test_scans_disagree_as_their_poses_do(distance):
    apart = scan_disagreement(moved_room(distance, 60_000))
    assert apart == pytest.approx(1.4826 * distance, rel=0.15)


def test_well_registered_scans_agree():
    assert scan_disagreement(moved_room(0.0)) < 0.002


def test_the_frame_does_not_matter():
    scans = moved_room(0.03)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)).double())[
        0
    ]
    far = torch.tensor([1000.0, -500.0, 30.0], dtype=torch.float64)
    turned = Scans(
        scans.origins @ turn + far, scans.ends @ turn + far, scans.scan_id, scans.is_return
    )
    assert scan_disagreement(turned) == pytest.approx(scan_disagreement(scans), rel=0.2)


def grid_wall(height, origin, count=60):
    """A scan of a wall in the plane z = height, 3 m wide [m]."""
    axis = torch.linspace(0, 3, count, dtype=torch.float64)
    ends = torch.cartesian_prod(axis, axis)
    ends = torch.cat([ends, torch.full((len(ends), 1), height).double()], dim=1)
    noise = torch.Generator().manual_seed(int(100 * height))
    ends += 0.002 * torch.randn(ends.shape, generator=noise, dtype=torch.float64)
    return torch.tensor([origin], dtype=torch.float64), ends


def joined(*parts):
    origins, ends = zip(*parts, strict=True)
    scan_id = torch.cat([torch.full((len(part),), i) for i, part in enumerate(ends)])
    return Scans(torch.cat(origins), torch.cat(ends), scan_id)


def test_the_two_sides_of_a_wall_are_two_surfaces():
    front = grid_wall(0.0, [1.5, 1.5, -2.0])
    assert scan_disagreement(joined(front, grid_wall(0.2, [1.5, 1.5, 2.0]))) == 0
    same_side = scan_disagreement(joined(front, grid_wall(0.2, [1.0, 1.5, -2.0])))
    assert same_side == pytest.approx(1.4826 * 0.2, rel=0.05)


def test_flat_scans_disagree_too():
    axis = torch.linspace(0, 6, 3000, dtype=torch.float64)
    walls = [torch.stack([axis, torch.full_like(axis, y)], dim=1) for y in (2.0, 2.03)]
    rng = torch.Generator().manual_seed(0)
    walls = [wall + 0.002 * torch.randn(wall.shape, generator=rng) for wall in walls]
    origin = torch.tensor([[3.0, 0.0]], dtype=torch.float64)
    apart = scan_disagreement(joined((origin, walls[0]), (origin, walls[1])))
    assert apart == pytest.approx(1.4826 * 0.03, rel=0.1)


def test_scans_that_share_no_surface_do_not_disagree():
    one = grid_wall(0.0, [1.5, 1.5, -2.0])
    assert scan_disagreement(joined(one)) == 0
    assert scan_disagreement(joined(one, grid_wall(40.0, [1.5, 1.5, 35.0]))) == 0
    empty = Scans(torch.zeros(1, 3), torch.zeros(0, 3))
    assert scan_disagreement(empty) == 0


def test_only_hits_are_blurred():
    points = torch.zeros(9000, 3)
    labels = torch.tensor([0.0, 0.5, 1.0]).repeat(3000)
    found = blurred_hits(points, labels, 0.03, torch.Generator().manual_seed(0))
    assert bool((found[labels < 1] == 0).all())
    torch.testing.assert_close(
        found[labels == 1].std(dim=0), torch.full((3,), 0.03), rtol=0.05, atol=0
    )
    assert bool((points == 0).all())
    assert blurred_hits(points, labels, 0.0, torch.Generator()) is points


def hit_rate(model, points):
    with torch.no_grad():
        return float((model(points) > 0.5).double().mean())


@pytest.fixture(scope="module")
def samples():
    return sample_rays(moved_room(0.0, 9000), SamplingConfig(behind_samples=0))


@pytest.fixture(scope="module")
def plain(samples):
    return LardHilbertMap().fit(samples.points, samples.labels)


@pytest.fixture(scope="module")
def blurred(samples):
    return LardHilbertMap().fit(samples.points, samples.labels, config=FitConfig(hit_noise=0.05))


@pytest.fixture(scope="module")
def misses(plain):
    """Hits of a badly registered scan that the plain map does not know."""
    hits = moved_room(0.0, 9000, seed=1).ends
    hits = hits + 0.08 * torch.nn.functional.normalize(torch.tensor([1.0, 1.0, 1.0]), dim=0)
    with torch.no_grad():
        return hits[plain(hits) < 0.4]


def test_a_blurred_map_knows_the_surfaces_of_a_badly_registered_scan(
    plain, blurred, misses, samples
):
    assert len(misses) > 100
    assert hit_rate(blurred, misses) > 0.4
    torch.testing.assert_close(blurred.means, plain.means)  # clusters are those of the points
    free = samples.points[samples.labels == 0]
    assert hit_rate(blurred, free) < 0.06


def test_tuning_keeps_the_thickness_if_it_is_given(blurred, misses, samples):
    rates = []
    for noise in (0.0, 0.05):
        model = LardHilbertMap()
        model.load_state_dict(blurred.state_dict())
        config = TuneConfig(epochs=1, hit_noise=noise)
        fine_tune(model, samples.points, samples.labels, config=config)
        rates.append(hit_rate(model, misses))
    assert rates[1] > rates[0] + 0.1


def test_updates_blur_hits_if_they_are_told_to(plain, misses, samples):
    rates = []
    for noise in (0.0, 0.05):
        model = LardHilbertMap()
        model.load_state_dict(plain.state_dict())
        config = UpdateConfig(fit=FitConfig(passes=4, batch_size=1024, hit_noise=noise))
        model.update(samples.points, samples.labels, config=config)
        rates.append(hit_rate(model, misses))
    assert rates[1] > rates[0] + 0.1


@pytest.mark.parametrize("config", [FitConfig, TuneConfig])
@pytest.mark.parametrize("noise", [-0.1, float("nan"), float("inf")])
def test_the_noise_is_a_length(config, noise):
    with pytest.raises(ValueError, match=r"hit_noise must be 0 or more, in meters; got"):
        config(hit_noise=noise)


def test_the_command_line_estimates_the_noise_or_takes_it(tmp_path, capsys):
    path = tmp_path / "room.npz"
    save_scans(moved_room(0.1, 9000), path)
    apart = scan_disagreement(load_scans(path))
    for name, words in (("auto", ["auto"]), ("given", [apart]), ("none", [0])):
        run("fit", path, "-o", tmp_path / f"{name}.pt", "--clusters", 100, "--hit-noise", *words)
        assert f"scans disagree by {100 * apart:.1f} cm" in capsys.readouterr().out
    auto, given, none = (
        LardHilbertMap.load(tmp_path / f"{name}.pt").weights for name in ("auto", "given", "none")
    )
    torch.testing.assert_close(auto, given)
    assert not torch.allclose(auto, none)


def test_the_command_line_refuses_other_noise(tmp_path, capsys):
    path = tmp_path / "room.npz"
    save_scans(moved_room(0.0, 300), path)
    with pytest.raises(SystemExit):
        run("fit", path, "-o", tmp_path / "map.pt", "--hit-noise", "-1")
    assert "a length must be 0 or more meters, or auto; got '-1'" in capsys.readouterr().err
    words = ("fit", path, "-o", tmp_path / "map.pt", "--incremental", "--hit-noise", "auto")
    assert "--hit-noise needs all scans at once; omit --incremental" in fails(capsys, *words)
