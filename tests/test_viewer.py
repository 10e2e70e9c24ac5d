import importlib.util
import io
import json
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from chromium import chromium, chromium_path
from scipy.spatial import cKDTree

from lardhm_torch import LardHilbertMap, Scans, cli, sample_rays, save_scans, simulate_room
from lardhm_torch.surfaces import vertex_colors
from lardhm_torch.surfaces.simplification import simplify_mesh
from lardhm_torch.viewing import scene
from lardhm_torch.viewing.viewer import LiveView, MapViewer, ViewConfig

PATIENCE = 120_000  # [ms] a shared machine draws in software

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("viser") is None, reason="viser is not installed"
)


@pytest.fixture(scope="module")
def scans():
    return simulate_room(6000, seed=0)


@pytest.fixture(scope="module")
def model(scans):
    samples = sample_rays(scans)
    return LardHilbertMap().fit(samples.points, samples.labels, 400)


@pytest.fixture(scope="module")
def browser():
    """A real Chromium; the test is skipped with a reason where there is none."""
    pytest.importorskip("playwright", reason="playwright is not installed")
    if chromium_path() is None:
        pytest.skip("no Chromium is installed")
    with chromium() as browser:
        yield browser


@pytest.fixture
def page(browser):
    page = browser.new_page(viewport={"width": 900, "height": 600})
    page.set_default_timeout(PATIENCE)
    yield page
    page.close()


def settled(page):
    """What the 3-D part of the page shows (H, W, 3), once it does not change any more."""
    from PIL import Image

    before = None
    for _ in range(100):
        page.wait_for_timeout(700)
        png = page.screenshot(clip={"x": 0, "y": 150, "width": 560, "height": 400})
        now = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)
        if before is not None and np.abs(now - before).max() < 8:
            return now
        before = now
    raise AssertionError("the page does not come to rest")


def share_changed(one, other):
    return float((np.abs(one - other).max(axis=2) > 24).mean())


def share_drawn(picture):
    return float((picture.min(axis=2) < 240).mean())


def test_what_is_clicked_in_the_browser_is_seen(model, scans, page):
    shown = MapViewer(model, scans, ViewConfig(resolution=0.1))
    try:
        page.goto(shown.url)
        page.get_by_text("surface of").wait_for()
        all_of_it = settled(page)
        assert share_drawn(all_of_it) > 0.05

        page.get_by_label("show points").click()
        page.get_by_label("show sensors").click()
        surface = settled(page)
        assert share_changed(all_of_it, surface) > 0.005

        page.get_by_role("slider").nth(0).focus()
        page.keyboard.press("End")  # threshold 0.99: the surface shrinks
        page.wait_for_timeout(1000)
        shown.wait()
        assert shown._threshold.value == pytest.approx(0.99)
        page.get_by_text("surface of").wait_for()
        thin = settled(page)
        assert share_changed(surface, thin) > 0.01
        assert share_drawn(thin) < share_drawn(surface)

        page.get_by_label("show surface").click()
        nothing = settled(page)
        assert share_drawn(nothing) < 0.02

        page.get_by_label("show slice").click()
        page.wait_for_timeout(1000)
        shown.wait()
        cut = settled(page)
        assert share_drawn(cut) > 0.03
        blue = (cut[..., 2] - cut[..., 0] > 60).mean()
        red = (cut[..., 0] - cut[..., 2] > 60).mean()
        assert blue > red > 0  # more free than occupied
        page.get_by_label("show slice").click()

        page.get_by_label("show occupied").click()
        clusters = settled(page)
        assert share_drawn(clusters) > 0.01
        assert (clusters[..., 0] - clusters[..., 2] > 40).mean() > 0.005  # they are red
    finally:
        shown.close()


def flat_scans(scans):
    """The scans of a room as a 2-D scanner sees them, 1 m to 1.5 m above its floor."""
    level = (scans.ends[:, 2] > 1) & (scans.ends[:, 2] < 1.5)
    return Scans(scans.origins[:, :2], scans.ends[level, :2], scans.scan_id[level])


def test_a_flat_map_is_a_picture_of_probabilities_with_its_hits_and_sensors(scans, page):
    flat = flat_scans(scans)
    samples = sample_rays(flat)
    model = LardHilbertMap(2).fit(samples.points, samples.labels, 200)
    shown = MapViewer(model, flat)
    try:
        page.goto(shown.url)
        page.get_by_text(f"{len(model)} clusters").wait_for()
        shown.wait()
        both = settled(page)
        blue = (both[..., 2] - both[..., 0] > 60).mean()
        red = (both[..., 0] - both[..., 2] > 60).mean()
        assert blue > red > 0.005
        page.get_by_label("show points").click()
        page.get_by_label("show sensors").click()
        picture = settled(page)
        assert share_changed(both, picture) > 0.001
        page.get_by_label("show probability").click()
        page.wait_for_timeout(1000)
        shown.wait()
        assert share_drawn(settled(page)) < 0.02
        with pytest.raises(ValueError, match="must be a 2-D map to be viewed; got 3-D"):
            shown.update(LardHilbertMap(3))
    finally:
        shown.close()


def test_a_viewer_that_is_closed_gives_up_what_it_draws(model):
    shown = MapViewer(model, config=ViewConfig(resolution=0.004))  # would take minutes
    worker = shown._worker
    while not shown._lattices:
        time.sleep(0.01)
    shown.close()
    worker.join(60)
    assert not worker.is_alive()


def test_the_command_ends_at_once_while_it_draws(model, tmp_path):
    model.save(tmp_path / "map.pt")
    command = [sys.executable, "-m", "lardhm_torch.cli", "view", str(tmp_path / "map.pt")]
    command += ["--resolution", "0.004"]  # would take minutes
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        next(line for line in process.stdout if "Ctrl-C stops it" in line)
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
        assert "stopped" in process.stdout.read()


def test_a_map_under_construction_is_shown_as_it_grows(scans, page):
    samples = sample_rays(scans.select(scans.scan_id == 0))
    model = LardHilbertMap().fit(samples.points, samples.labels, 200)
    shown = MapViewer(model, config=ViewConfig(resolution=0.1))
    try:
        page.goto(shown.url)
        page.get_by_text(f"{len(model)} clusters").wait_for()
        first = settled(page)
        samples = sample_rays(scans)
        model.fit(samples.points, samples.labels, 400)
        shown.update(model)
        page.get_by_text(f"{len(model)} clusters").wait_for()
        assert share_changed(first, settled(page)) > 0.01
    finally:
        shown.close()


def test_an_exported_scene_opens_without_a_server(model, page, tmp_path):
    shown = MapViewer(model, config=ViewConfig(resolution=0.1))
    try:
        shown.export(tmp_path / "scene.html")
        shown.export(tmp_path / "scene.viser")
        with pytest.raises(ValueError, match=r"must end in \.html or \.viser.*got 'scene\.obj'"):
            shown.export(tmp_path / "scene.obj")
    finally:
        shown.close()
    assert (tmp_path / "scene.viser").stat().st_size > 10_000
    assert sorted(p.name for p in tmp_path.iterdir()) == ["scene.html", "scene.viser"]
    page.goto((tmp_path / "scene.html").as_uri())
    page.wait_for_timeout(3000)
    assert share_drawn(settled(page)) > 0.05


def test_the_commands_write_a_scene_and_pictures(model, scans, tmp_path, capsys):
    model.save(tmp_path / "map.pt")
    save_scans(scans, tmp_path / "scans.npz")
    commands = (
        "view map.pt scans.npz --export scene.html --resolution 0.2",
        "render map.pt -o surface.png --resolution 0.2 --cut-above 2.2",
        "render map.pt -o slice.png --slice 1.0",
    )
    for command in commands:
        verb, *words = command.split()
        paths = [str(tmp_path / w) if "." in w and not w[0].isdigit() else w for w in words]
        assert cli.main([verb, *paths]) == 0, capsys.readouterr().err
    for name in ("scene.html", "surface.png", "slice.png"):
        assert (tmp_path / name).stat().st_size > 5000


def test_a_flat_or_empty_map_is_refused():
    with pytest.raises(ValueError, match="must be a 2-D or 3-D map to be viewed; got 4-D"):
        MapViewer(LardHilbertMap(dim=4))
    with pytest.raises(ValueError, match="it is empty: fit it first"):
        MapViewer(LardHilbertMap())


def test_the_page_of_a_map_to_come_opens_with_its_first_cluster(model):
    live = LiveView(ViewConfig(resolution=0.3))
    live.update(LardHilbertMap())
    assert live.viewer is None
    live.update(model)
    live.update(model)
    assert live.viewer.url.startswith("http://127.0.0.1:")
    live.viewer.wait()
    live.close()


def test_the_page_shows_no_more_than_its_budgets_and_the_mesh_keeps_its_faces(scans):
    mesh = trimesh.creation.icosphere(5)  # 20,480 faces
    mesh.visual.vertex_colors = np.tile([10, 200, 30, 255], (len(mesh.vertices), 1))
    fewer = simplify_mesh(mesh, 2000)
    assert 1000 < len(fewer.faces) <= 2000
    assert len(mesh.faces) == 20_480
    points, colors = scene.scan_points(scans, 1500, np.zeros(3))
    assert 700 < len(points) <= 1500
    assert len(colors) == len(points)
    everywhere = scene.scan_points(scans, 10**6, np.zeros(3))[0]
    assert len(everywhere) == len(scans.hits)
    gaps = cKDTree(points).query(everywhere)[0]
    assert gaps.max() < 0.5  # evenly thinned: none of the room is left out


def flat_map(thickness):
    """Wide flat clusters, as thick as that (standard deviation) [m]."""
    factor = torch.diag(torch.tensor([20.0, 20.0, thickness]))
    return SimpleNamespace(
        scale_tril=factor.expand(10, 3, 3), weights=torch.ones(10), covariance_scale=4.0
    )


def test_cells_are_small_where_surfaces_are_thin_but_not_too_many():
    thick, thin, thinner = (scene.view_resolution(flat_map(t)) for t in (1.0, 0.18, 0.001))
    assert thin == pytest.approx(scene.SHEET_CELLS * 0.18, rel=0.03)
    assert thick > thin > thinner
    assert thick / thinner == pytest.approx((scene.MAX_MESH_FACES / scene.MESH_FACES) ** 0.5)


def test_painted_light_is_brighter_on_what_faces_it():
    ball = trimesh.creation.icosphere(3)
    ball.visual.vertex_colors = np.tile([200, 100, 50, 255], (len(ball.vertices), 1))
    glb = scene.painted_glb(ball)
    end = 20 + int.from_bytes(glb[12:16], "little")
    tree, binary = json.loads(glb[20:end]), glb[end + 8 :]
    (primitive,) = tree["meshes"][0]["primitives"]
    accessor = tree["accessors"][primitive["attributes"]["COLOR_0"]]
    start = tree["bufferViews"][accessor["bufferView"]]["byteOffset"]
    count = len(ball.vertices)
    colors = np.frombuffer(binary, "u1", 4 * count, start).reshape(count, 4)[:, :3]
    brightness = colors.astype(int).sum(axis=1)
    toward = ball.vertices @ scene.KEY_LIGHT
    assert brightness[toward > 0.9].min() > brightness[toward < 0].max()
    assert b"KHR_materials_unlit" in glb


class UnsureMap(LardHilbertMap):
    """Unsure in proportion to the height; or not yet, like a map without posterior."""

    ready = True

    def variance(self, points):
        if not self.ready:
            raise RuntimeError("no posterior")
        return points[..., 2].clamp(min=0)


def test_variance_is_offered_where_the_map_knows_it_and_colors_grow_with_it():
    unsure = UnsureMap()
    unsure.load_state_dict(LardHilbertMap().fit(torch.rand(50, 3), torch.ones(50), 3).state_dict())
    assert vertex_colors.has_variance(unsure)
    colors = vertex_colors.variance_colors(
        unsure, np.array([[0, 0, z] for z in (0.01, 0.1, 1.0, 10.0)])
    )
    assert (np.diff(colors[:, :3].astype(int).sum(axis=1)) > 0).all()
    unsure.ready = False
    assert not vertex_colors.has_variance(unsure)
    assert not vertex_colors.has_variance(LardHilbertMap())


def test_ellipsoids_are_turned_as_their_clusters_are():
    rotation = torch.linalg.qr(torch.randn(4, 3, 3, dtype=torch.float64))[0]
    rotation[torch.linalg.det(rotation) < 0, :, 2] *= -1
    w, x, y, z = scene.quaternions(rotation.numpy()).T.astype(np.float64)
    first_column = np.stack(
        [1 - 2 * (y**2 + z**2), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1
    )
    np.testing.assert_allclose(first_column, rotation[:, :, 0].numpy(), atol=1e-6)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"resolution": 0.0}, "resolution must be > 0 m; got 0.0"),
        ({"max_points": 0}, "max_points must be 1 or more; got 0"),
    ],
)
def test_bad_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        ViewConfig(**settings)
