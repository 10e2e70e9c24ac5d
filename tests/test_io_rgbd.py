"""Folders of depth images: 7-Scenes and TUM."""

import shutil
import sys
import tracemalloc

import numpy as np
import pytest
from healthy_files import write_depth_images, write_tum
from scan_files import real_scans, turning_poses

from lardhm_torch.io.scan_files import Camera, load_scans

Image = pytest.importorskip("PIL.Image", reason="pillow is not installed (extra io)")


@pytest.fixture
def frames(data):
    return data / "sevenscenes_rgbd/frames"


def some_images(count: int = 2) -> np.ndarray:
    return np.random.default_rng(0).integers(500, 4000, size=(count, 24, 32))


def as_tum(folder, frames, per_meter=5):
    """The original frames in the TUM layout: stamps, depth in 1/5000 m, poses as quaternions."""
    poses, lines = [], []
    (folder / "depth").mkdir()
    for number, image in enumerate(sorted(frames.glob("*.depth.png"))):
        depth = np.asarray(Image.open(image)).astype(np.uint16) * per_meter
        Image.fromarray(depth.astype(np.uint16)).save(folder / f"depth/{number}.png")
        lines.append(f"{1305031102.160407 + number:.6f} depth/{number}.png\n")
        poses.append(np.loadtxt(str(image).replace(".depth.png", ".pose.txt")))
    (folder / "depth.txt").write_text("# timestamp filename\n" + "".join(lines))
    stamps = 1305031102.160407 + np.arange(len(poses))
    write_tum(folder / "groundtruth.txt", stamps, np.array(poses))
    shutil.copy(frames / "camera-intrinsics.txt", folder)


def test_the_original_images_give_the_stored_scans(data, frames):
    arrays = real_scans(data, "sevenscenes_rgbd")
    scans = load_scans(frames, camera=Camera(pixel_step=3))
    numbers = np.searchsorted(arrays["source_index"], [0, 40, 80, 120, 160, 200])
    assert np.array_equal(scans.origins, arrays["origins"][numbers])
    stored = [arrays["points"][arrays["scan_id"] == number] for number in numbers]
    assert np.allclose(scans.ends, np.concatenate(stored), rtol=0, atol=5e-7)  # float32 there
    assert scans.scan_id.bincount().tolist() == [len(points) for points in stored]


def test_the_same_images_in_the_tum_layout_give_the_same_scans(frames, tmp_path):
    as_tum(tmp_path, frames)
    ours, theirs = load_scans(tmp_path), load_scans(frames)
    # The stored matrices are no exact rotations (2e-4 off), and a quaternion is one.
    assert np.allclose(ours.ends, theirs.ends, rtol=0, atol=1e-3)
    assert np.allclose(ours.origins, theirs.origins, rtol=0, atol=1e-9)
    assert np.allclose(ours.times.diff(), 1, rtol=0, atol=1e-5)
    assert ours.times[0] == 1305031102.160407
    assert theirs.times is None


def test_a_pixel_is_where_the_pinhole_says(tmp_path):
    image = np.zeros((1, 24, 32))
    image[0, 4, 8], image[0, 4, 12], image[0, 8, 8] = 2000, 65535, 1000
    write_depth_images(tmp_path, image, np.eye(4)[None])
    camera = Camera(intrinsics=(100, 50, 16, 12))
    ends = load_scans(tmp_path, camera=camera).ends
    assert np.allclose(ends, [[-0.16, -0.32, 2], [-0.08, -0.08, 1]])


def test_intrinsics_come_from_the_option_the_folder_or_the_one_above(tmp_path):
    folder = tmp_path / "seq-01"
    folder.mkdir()
    write_depth_images(folder, some_images(), turning_poses(2))
    beside = load_scans(folder).ends
    (folder / "camera-intrinsics.txt").rename(tmp_path / "camera-intrinsics.txt")
    assert np.array_equal(load_scans(folder).ends, beside)
    (tmp_path / "camera-intrinsics.txt").write_text("585 585 320 240\n")
    assert np.array_equal(load_scans(folder).ends, beside)
    (tmp_path / "camera-intrinsics.txt").unlink()
    camera = Camera(intrinsics=(585, 585, 320, 240))
    assert np.array_equal(load_scans(folder, camera=camera).ends, beside)
    with pytest.raises(ValueError, match=r"camera-intrinsics\.txt .*Camera\(.*--camera FX,FY"):
        load_scans(folder)


def test_images_where_tracking_was_lost_are_left_out_with_a_warning(tmp_path):
    write_depth_images(tmp_path, some_images(3), turning_poses(3))
    (tmp_path / "frame-000001.pose.txt").write_text("-inf -inf -inf -inf\n" * 4)
    with pytest.warns(UserWarning, match="1 depth images have no pose and are left out"):
        scans = load_scans(tmp_path)
    assert np.array_equal(scans.origins, turning_poses(3)[[0, 2], :3, 3])


def test_tum_images_take_the_pose_between_two_stamps_and_none_from_far_away(frames, tmp_path):
    as_tum(tmp_path, frames)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, 0, 3] = [0, 3]
    write_tum(tmp_path / "groundtruth.txt", 1305031102.160407 + np.array([0.9, 1.2]), poses)
    with pytest.warns(UserWarning, match="5 depth images have no pose"):
        scans = load_scans(tmp_path)
    assert np.allclose(scans.origins, [[1, 0, 0]], atol=1e-5)  # stamps have a microsecond


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("frame-000000.depth.png", b"", "frame-000000.depth.png cannot be read"),
        ("frame-000001.pose.txt", b"1 0 0 0\n", r"pose\.txt must hold 4 x 4 numbers; got \(1, 4\)"),
        ("frame-000001.pose.txt", b"1 two\n", r"pose\.txt must hold 4 x 4 numbers"),
        ("frame-000001.pose.txt", b"2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "must hold rotations"),
        ("camera-intrinsics.txt", b"0 0 0\n0 5 0\n0 0 1\n", "must give fx, fy > 0"),
        ("camera-intrinsics.txt", b"5 0\n0 5\n", "must give fx, fy > 0"),
        ("depth.txt", b"1.5 ../secret.png\n", r"a stamp and a file in each line; got '1\.5 \.\."),
        ("depth.txt", b"noon a.png\n", "a stamp and a file in each line"),
        ("depth.txt", b"1.5 a.png\n", r"poses are needed beside depth\.txt: groundtruth\.txt"),
    ],
)
def test_what_is_wrong_in_a_folder_of_images_is_said(tmp_path, name, content, message):
    write_depth_images(tmp_path, some_images(), turning_poses(2))
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"{tmp_path.name} cannot be read: .*{message}"):
        load_scans(tmp_path)


def test_a_missing_image_or_pose_is_named(frames, tmp_path):
    as_tum(tmp_path, frames)
    (tmp_path / "depth/3.png").unlink()
    with pytest.raises(ValueError, match=r"depth image .*3\.png is missing"):
        load_scans(tmp_path)
    (tmp_path / "depth.txt").unlink()
    write_depth_images(tmp_path, some_images(), turning_poses(2))
    (tmp_path / "frame-000001.pose.txt").unlink()
    with pytest.raises(ValueError, match=r"there is no frame-000001\.pose\.txt"):
        load_scans(tmp_path)


def test_only_16_bit_images_of_some_size_are_depth(tmp_path):
    path = write_depth_images(tmp_path, some_images(), turning_poses(2))
    Image.new("RGB", (4, 4)).save(path)
    with pytest.raises(ValueError, match=r"16 bits a pixel .* got mode RGB"):
        load_scans(tmp_path)
    Image.new("I;16", (1 << 13, 1 << 13)).save(path)  # 50 kB that unfold to 128 MB
    with pytest.raises(ValueError, match=r"at most 33554432 pixels .* 8192 x 8192"):
        load_scans(tmp_path)
    write_depth_images(tmp_path, np.zeros((2, 4, 4)), turning_poses(2))
    with pytest.raises(ValueError, match="at least one pixel with a depth is needed"):
        load_scans(tmp_path)


def test_a_chunk_of_an_image_takes_no_more_memory_than_the_file(tmp_path):
    path = write_depth_images(tmp_path, some_images(), turning_poses(2))
    content = bytearray(path.read_bytes())
    at = content.index(b"IDAT") - 4
    content[at : at + 4] = (1 << 30).to_bytes(4, "big")
    whole = load_scans(tmp_path)
    path.write_bytes(content)
    tracemalloc.start()
    try:
        np.testing.assert_array_equal(load_scans(tmp_path).ends, whole.ends)  # Pillow tolerates it
        assert tracemalloc.get_traced_memory()[1] < 1 << 27
    finally:
        tracemalloc.stop()


def test_a_camera_is_checked():
    with pytest.raises(ValueError, match="intrinsics must give fx, fy > 0"):
        Camera(intrinsics=(0, 1, 2, 3))
    with pytest.raises(ValueError, match="pixel_step must be 1 pixel or more; got 0"):
        Camera(pixel_step=0)


def test_without_pillow_the_error_names_the_extra(tmp_path, monkeypatch):
    write_depth_images(tmp_path, some_images(), turning_poses(2))
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(ImportError, match=r"depth\.png needs pillow.*lardhm_torch\[io\]"):
        load_scans(tmp_path)


def tum_folder(folder, listed, per_meter=5000, intrinsics="5 0 15.5\n0 5 11.5\n0 0 1\n"):
    """Two images of 2 m everywhere with stamps 1 and 2; what lists them, and how."""
    (folder / "depth").mkdir()
    for number in (1, 2):
        image = np.full((24, 32), 2 * per_meter, dtype=np.uint16)
        Image.fromarray(image).save(folder / f"depth/{number}.png")
    name, line = listed
    (folder / name).write_text("# made here\n" + "".join(line.format(i) for i in (1, 2)))
    write_tum(folder / "groundtruth.txt", [1, 2], turning_poses(2))
    (folder / "camera-intrinsics.txt").write_text(intrinsics)


LISTS = [
    ("depth.txt", "{0} depth/{0}.png\n"),
    ("depth.txt", "{0} depth/{0}.png {0} rgb/{0}.png\n"),
    ("associations.txt", "{0} depth/{0}.png {0} rgb/{0}.png\n"),
    ("associations.txt", "{0} rgb/{0}.png {0} depth/{0}.png\n"),
    ("associate.txt", "{0} rgb/{0}.png {0} ./depth/{0}.png\n"),
]


@pytest.mark.parametrize("listed", LISTS)
@pytest.mark.parametrize("per_meter", [1000, 5000, 6553.5])
def test_lists_of_pairs_and_other_depth_scales_are_read(tmp_path, listed, per_meter):
    tum_folder(tmp_path, listed, int(per_meter))
    scale = int(per_meter)
    scans = load_scans(tmp_path, camera=Camera(depth_scale=scale, pixel_step=1), strict=True)
    poses = turning_poses(2)
    assert np.allclose(scans.origins, poses[:, :3, 3], rtol=0, atol=1e-8)
    for number, pose in enumerate(poses):
        local = (scans.ends[scans.scan_id == number].numpy() - pose[:3, 3]) @ pose[:3, :3]
        assert np.allclose(local[:, 2], 2, rtol=0, atol=1e-6)
        assert np.allclose(local[0, :2], [-15.5 / 5 * 2, -11.5 / 5 * 2], rtol=0, atol=1e-6)


def test_the_default_depth_scale_is_a_guess(tmp_path):
    tum_folder(tmp_path, LISTS[0])
    with pytest.raises(ValueError, match=r"strict.*5000 depth units per meter.*--depth-scale"):
        load_scans(tmp_path, strict=True)


def test_a_negative_fy_turns_y_up(tmp_path):
    tum_folder(tmp_path, LISTS[0], intrinsics="5 0 15.5\n0 -5 11.5\n0 0 1\n")
    up = load_scans(tmp_path, camera=Camera(pixel_step=1))
    (tmp_path / "camera-intrinsics.txt").write_text("5 0 15.5\n0 5 11.5\n0 0 1\n")
    down = load_scans(tmp_path, camera=Camera(pixel_step=1))
    pose = turning_poses(2)[0]
    ours, theirs = [
        (scans.ends[scans.scan_id == 0].numpy() - pose[:3, 3]) @ pose[:3, :3]
        for scans in (up, down)
    ]
    assert np.allclose(ours, theirs * [1, -1, 1], rtol=0, atol=1e-6)


def test_images_before_the_first_pose_are_left_out(tmp_path):
    tum_folder(tmp_path, LISTS[2])
    poses = turning_poses(2)
    write_tum(tmp_path / "groundtruth.txt", [2, 3], poses)
    with pytest.warns(UserWarning, match="1 depth images have no pose and are left out"):
        scans = load_scans(tmp_path)
    assert np.allclose(scans.origins, poses[:1, :3, 3], rtol=0, atol=1e-8)


def test_a_depth_scale_is_checked():
    with pytest.raises(ValueError, match="depth_scale must be > 0 units per meter"):
        Camera(depth_scale=0)
