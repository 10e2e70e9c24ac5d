import math

import pytest
import torch
from scipy.spatial import cKDTree
from small_maps import F64

from lardhm_torch import LardHilbertMap, sample_rays, signed_distance, simulate_room
from lardhm_torch.evaluation.calibration import calibration_error
from lardhm_torch.queries.bodies import (
    Body,
    body_collision_probability,
    body_distance,
    capsule_distance,
    collision_probability,
)


@pytest.fixture(scope="module")
def room():
    samples = sample_rays(simulate_room())
    return LardHilbertMap().fit(samples.points, samples.labels).requires_grad_(False)


def places(count, seed):
    rng = torch.Generator().manual_seed(seed)
    return torch.rand(count, 3, generator=rng, dtype=F64) * torch.tensor([8, 5, 2.6]).double()


def random_poses(count, seed):
    """Turned about the vertical, somewhere in the room."""
    rng = torch.Generator().manual_seed(seed)
    angle = 7 * torch.rand(count, generator=rng, dtype=F64)
    poses = torch.eye(4, dtype=F64).repeat(count, 1, 1)
    poses[:, 0, 0] = poses[:, 1, 1] = angle.cos()
    poses[:, 1, 0], poses[:, 0, 1] = angle.sin(), -angle.sin()
    poses[:, :3, 3] = places(count, seed)
    return poses


def robot():
    return Body(torch.tensor([[0.0, 0, 0.2], [0.3, 0, 0.2], [-0.3, 0.1, 0.5]]), [0.25, 0.2, 0.1])


def sphere_points(count):
    number = torch.arange(count, dtype=F64) + 0.5
    up, turn = 1 - 2 * number / count, math.pi * (1 + 5**0.5) * number
    flat = (1 - up.square()).sqrt()
    return torch.stack([flat * turn.cos(), flat * turn.sin(), up], dim=1)


def test_the_distance_of_a_body_is_that_of_dense_points_on_its_spheres(room):
    body, poses = robot(), random_poses(40, 1)
    found = body_distance(room, body, poses)
    free = found > 0.05
    assert free.sum() > 10
    shell = body.centers[:, None] + body.radii[:, None, None] * sphere_points(3000)
    world = poses[:, None, None, :3, :3] @ shell[..., None] + poses[:, None, None, :3, 3:]
    dense = signed_distance(room, world.squeeze(-1)).flatten(1).amin(dim=1)
    agree = (found - dense)[free].abs() < 1e-2  # not where the sign jumps, in a pocket never seen
    assert agree.double().mean() > 0.94


def test_the_probability_of_a_body_is_that_of_dense_points_on_its_spheres(room):
    """Of a point, P(distance < 0) is the probability that the surface has moved beyond it."""
    body, poses = robot(), random_poses(150, 1)
    distance = body_distance(room, body, poses)
    poses = poses[(distance > 0) & (distance < 0.1)]
    found = body_collision_probability(room, body, poses)
    centers = body.placed(poses).requires_grad_()
    (away,) = torch.autograd.grad(signed_distance(room, centers).sum(), centers)
    around = away[:, :, None] + 0.1 * torch.randn(1, 1, 500, 3, dtype=F64)  # toward the surface
    ways = torch.cat(
        [-away[:, :, None], -around, sphere_points(500).expand(*away.shape[:2], -1, 3)], 2
    )
    ways = ways / ways.norm(dim=-1, keepdim=True)
    shell = centers.detach()[:, :, None] + body.radii[:, None, None] * ways
    dense = collision_probability(room, shell, 0.0)
    dense = torch.where(signed_distance(room, shell) < 0, 0.0, dense)  # a pocket never seen
    assert ((found > 0.01) & (found < 0.99)).sum() > 3
    torch.testing.assert_close(found, dense.flatten(1).amax(dim=1), rtol=0, atol=1e-3)


def test_the_distance_of_a_capsule_is_that_of_dense_points_on_its_axis(room):
    starts, ends = places(60, 2), places(60, 3)
    found = capsule_distance(room, starts, ends, 0.1)
    share = torch.linspace(0, 1, 5001, dtype=F64)[:, None]
    dense = signed_distance(room, starts[:, None] + share * (ends - starts)[:, None])
    agree = (found - (dense.amin(dim=1) - 0.1)).abs() < 1e-2  # not where the sign jumps
    assert agree.double().mean() > 0.94
    same = capsule_distance(room, starts, starts, torch.full((60,), 0.2))
    torch.testing.assert_close(same, signed_distance(room, starts) - 0.2)


def test_gradients_with_respect_to_poses_pass_gradcheck(room):
    poses = random_poses(6, 4)[:, :3].requires_grad_()
    last = torch.tensor([[[0.0, 0, 0, 1]]], dtype=F64).expand(6, 1, 4)

    def whole(part):
        return torch.cat([part, last], dim=1)

    assert torch.autograd.gradcheck(lambda p: body_distance(room, robot(), whole(p)), poses)
    assert torch.autograd.gradcheck(
        lambda p: body_collision_probability(room, robot(), whole(p)), poses, atol=1e-4
    )
    starts, ends = places(6, 5).requires_grad_(), places(6, 6).requires_grad_()
    found = capsule_distance(room, starts, ends)
    found.sum().backward()
    step = 1e-4 * torch.randn(6, 3, generator=torch.Generator().manual_seed(0), dtype=F64)
    moved = capsule_distance(room, starts + step, ends) - found
    torch.testing.assert_close(moved, (starts.grad * step).sum(dim=1), rtol=0, atol=2e-5)


def test_the_probability_of_a_collision_is_calibrated_in_a_room_that_chose_nothing():
    samples = sample_rays(simulate_room(seed=7))
    model = LardHilbertMap().fit(samples.points, samples.labels).requires_grad_(False)
    scans = simulate_room(3000, seed=8, noise=0.0)
    scans = scans.select(scans.is_return)
    rng = torch.Generator().manual_seed(0)
    before = 0.6 * torch.rand(len(scans), 1, generator=rng, dtype=F64).minimum(
        scans.ranges[:, None]
    )
    points = scans.ends - before * (scans.ends - scans.ray_origins) / scans.ranges[:, None]
    dense = simulate_room(300_000, seed=9, noise=0.0)
    true = torch.from_numpy(cKDTree(dense.ends[dense.is_return]).query(points)[0])
    radii = (true + 0.1 * torch.randn(len(true), generator=rng, dtype=F64)).clamp(min=0.01)
    found = collision_probability(model, points, radii)
    even = torch.full_like(found, 1 / len(found))
    assert float(calibration_error(found, (true < radii).to(F64), even)) < 0.03


def test_probabilities_rise_with_the_radius_and_are_zero_in_an_empty_map(room):
    points = places(200, 9)
    near, far = (collision_probability(room, points, radius) for radius in (0.1, 0.3))
    assert ((near >= 0) & (far <= 1) & (near <= far)).all()
    assert (collision_probability(LardHilbertMap(), points, 1.0) == 0).all()
    assert (body_distance(LardHilbertMap(), robot(), random_poses(2, 0)) == math.inf).all()
    assert (body_distance(LardHilbertMap(), robot(), random_poses(2, 0), 1.0) <= 0.9).all()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Body(torch.zeros(0, 3), []), r"at least one sphere; got \(0, 3\)"),
        (lambda: Body(torch.zeros(1, 3), [-1.0]), r"radii must be 0 m or more.*-1.0"),
        (lambda: robot().placed(torch.eye(3)), r"poses must be \(\.\.\., 4, 4\); got \(3, 3\)"),
        (lambda: robot().placed(2 * torch.eye(4)), "poses must have the last row"),
        (
            lambda: capsule_distance(LardHilbertMap(), torch.zeros(1, 3), torch.zeros(2, 3)),
            r"starts and ends must be \(\.\.\., 3\) both",
        ),
    ],
)
def test_bad_bodies_and_poses_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
