import json
import math
import os
import pickle
import stat

import pytest
import torch

from lardhm_torch import LardHilbertMap, load_scans, sample_rays
from lardhm_torch.io.map_files import load_state, save_state


@pytest.fixture
def path(tmp_path):
    return tmp_path / "map.pt"


@pytest.fixture
def safe_path(tmp_path):
    return tmp_path / "map.safetensors"


def some_map() -> LardHilbertMap:
    points = torch.randn(50, 3) + torch.tensor([5e5, 4.5e6, 0])
    return LardHilbertMap(num_neighbors=3).fit(points, torch.arange(50) % 2)


class Bomb:
    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return os.mkdir, (str(self.target),)


def test_a_pickle_bomb_is_refused_and_does_not_go_off(path, tmp_path):
    for write in (torch.save, lambda state, p: p.write_bytes(pickle.dumps(state))):
        write({"weights": Bomb(tmp_path / "boom")}, path)
        with pytest.raises(
            ValueError, match=r"map\.pt must be a complete map file that is safe to load"
        ):
            LardHilbertMap.load(path)
        assert not (tmp_path / "boom").exists()


def test_a_file_cut_short_anywhere_is_refused(path):
    LardHilbertMap().fit(torch.randn(50, 3), torch.ones(50)).save(path)
    whole = path.read_bytes()
    for cut in (0, 1, 10, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:cut])
        with pytest.raises(ValueError, match=r"map\.pt must be a complete map file"):
            LardHilbertMap.load(path)


def test_a_missing_file_and_a_folder_are_named(path, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"map\.pt does not exist"):
        LardHilbertMap.load(path)
    with pytest.raises(FileNotFoundError, match="does not exist"):
        load_state(tmp_path)


@pytest.mark.parametrize(
    "content", [torch.zeros(3), {"weights": torch.zeros(3)}, {1: 2}, {"_extra_state": {}}]
)
def test_a_file_that_holds_something_else_is_named(path, content):
    torch.save(content, path)
    with pytest.raises(ValueError, match=r"map\.pt must hold a (state dict|LardHilbertMap)"):
        LardHilbertMap.load(path)


@pytest.mark.parametrize(
    "settings",
    [
        {"dim": -1}, {"dim": "3"}, {"colour": 1}, {"num_neighbors": 2.5}, {"dim": 10**9},
        {"num_neighbors": 2**62}, {"covariance_scale": math.inf}, {"min_lengthscale": math.nan},
    ],
)  # fmt: skip
def test_hostile_settings_are_refused(path, settings):
    state = LardHilbertMap().state_dict()
    state["_extra_state"].update(settings)
    torch.save(state, path)
    with pytest.raises(ValueError, match=r"map\.pt must hold a LardHilbertMap"):
        LardHilbertMap.load(path)


def test_a_failed_save_leaves_the_old_file_and_no_litter(path, monkeypatch):
    LardHilbertMap().save(path)
    before = path.read_bytes()

    def fail(state, file):
        file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(torch, "save", fail)
    with pytest.raises(OSError, match="disk full"):
        save_state({}, path)
    assert path.read_bytes() == before
    assert [entry.name for entry in path.parent.iterdir()] == ["map.pt"]


def test_a_map_comes_back_from_safetensors_as_from_torch(safe_path, path):
    model = some_map()
    model.save(safe_path)
    model.save(path)
    loaded, same = LardHilbertMap.load(safe_path), LardHilbertMap.load(path)
    assert loaded.settings == same.settings == model.settings
    for name, tensor in same.state_dict().items():
        if name != "_extra_state":
            assert torch.equal(loaded.state_dict()[name], tensor), name
            assert loaded.state_dict()[name].dtype == tensor.dtype


def test_a_map_of_real_scans_comes_back_from_safetensors(data, safe_path):
    samples = sample_rays(load_scans(data / "la3dm_sim_structured/scans.npz"), seed=0)
    model = LardHilbertMap().fit(samples.points, samples.labels, 200)
    model.save(safe_path)
    points = samples.points[::50]
    assert torch.equal(LardHilbertMap.load(safe_path)(points), model(points))


def test_equal_maps_have_equal_files(safe_path, path):
    model = some_map()
    for target in (safe_path, path):
        contents = set()
        for _ in range(10):
            model.save(target)
            contents.add(target.read_bytes())
        assert len(contents) == 1


def test_who_may_read_a_map_follows_the_umask(safe_path, path):
    before = os.umask(0o027)
    try:
        for target in (safe_path, path):
            some_map().save(target)
            assert stat.S_IMODE(target.stat().st_mode) == 0o640
    finally:
        os.umask(before)


def test_other_programs_find_the_settings_as_json(safe_path):
    from safetensors import safe_open

    some_map().save(safe_path)
    with safe_open(safe_path, "pt") as file:
        assert json.loads(file.metadata()["_extra_state"])["num_neighbors"] == 3
        assert file.get_tensor("origin").dtype == torch.float64


def test_a_loaded_map_does_not_hang_on_its_file(safe_path):
    some_map().save(safe_path)
    model = LardHilbertMap.load(safe_path)
    safe_path.write_bytes(bytes(safe_path.stat().st_size))
    assert float(model.weights.detach().abs().sum()) > 0


def test_safetensors_cut_short_anywhere_are_refused(safe_path):
    some_map().save(safe_path)
    whole = safe_path.read_bytes()
    for cut in (0, 1, 8, 100, len(whole) // 2, len(whole) - 1):
        safe_path.write_bytes(whole[:cut])
        with pytest.raises(ValueError, match=r"map\.safetensors must be a complete map file"):
            LardHilbertMap.load(safe_path)


def test_safetensors_without_settings_are_refused(safe_path):
    from safetensors.torch import save_file

    state = some_map().state_dict()
    del state["_extra_state"]
    for metadata in (None, {"_extra_state": "3"}, {"_extra_state": "[" * 10**5}):
        save_file(state, safe_path, metadata=metadata)
        with pytest.raises(ValueError, match=r"map\.safetensors must"):
            LardHilbertMap.load(safe_path)


def test_safetensors_without_a_checksum_are_refused(safe_path):
    from safetensors.torch import save_file

    state = some_map().state_dict()
    save_file(state, safe_path, {"_extra_state": json.dumps(state.pop("_extra_state"))})
    with pytest.raises(ValueError, match=r"map\.safetensors must be.*must hold a checksum"):
        LardHilbertMap.load(safe_path)


def test_a_checksum_covers_names_types_and_settings(safe_path):
    """Changes that leave every byte of the tensors as it was."""
    from safetensors import safe_open
    from safetensors.torch import load_file, save_file

    some_map().save(safe_path)
    with safe_open(safe_path, "pt") as file:
        metadata = file.metadata()
    tensors = load_file(safe_path)
    swapped = {
        **tensors,
        "posterior_means": tensors["weights"],
        "weights": tensors["posterior_means"],
    }
    cast = {**tensors, "counts": tensors["counts"].view(torch.float64)}
    other = {**metadata, "_extra_state": metadata["_extra_state"].replace("3", "4")}
    for changed, said in ((swapped, metadata), (cast, metadata), (tensors, other)):
        save_file(changed, safe_path, said)
        with pytest.raises(ValueError, match="the checksum of its content differs"):
            LardHilbertMap.load(safe_path)
    save_file(tensors, safe_path, metadata)
    LardHilbertMap.load(safe_path)


def test_the_checksum_of_torch_files_is_written_whatever_the_option_says(path):
    torch.serialization.set_crc32_options(False)
    try:
        some_map().save(path)
        assert not torch.serialization.get_crc32_options()
    finally:
        torch.serialization.set_crc32_options(True)
    LardHilbertMap.load(path)


def test_a_damaged_entry_of_a_torch_file_is_named(path):
    model = some_map()
    torch.save(model.state_dict(), path)
    content = path.read_bytes()
    weights = model.weights.detach().numpy().tobytes()
    path.write_bytes(content.replace(weights, bytes([weights[0] ^ 1]) + weights[1:]))
    with pytest.raises(ValueError, match=r"map\.pt must be.*checksum of its entry map/data/\d+"):
        LardHilbertMap.load(path)
