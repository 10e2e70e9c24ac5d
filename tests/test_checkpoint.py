import os
import pickle

import pytest
import torch

from lardhm_torch import LardHilbertMap
from lardhm_torch.checkpoint import load_state, save_state


@pytest.fixture
def path(tmp_path):
    return tmp_path / "map.pt"


class Bomb:
    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return os.mkdir, (str(self.target),)


def test_a_pickle_bomb_is_refused_and_does_not_go_off(path, tmp_path):
    for write in (torch.save, lambda state, p: p.write_bytes(pickle.dumps(state))):
        write({"weights": Bomb(tmp_path / "boom")}, path)
        with pytest.raises(ValueError, match=r"map\.pt must be a map file, whole and safe to load"):
            LardHilbertMap.load(path)
        assert not (tmp_path / "boom").exists()


def test_a_file_cut_short_anywhere_is_refused(path):
    LardHilbertMap().fit(torch.randn(50, 3), torch.ones(50)).save(path)
    whole = path.read_bytes()
    for cut in (0, 1, 10, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:cut])
        with pytest.raises(ValueError, match=r"map\.pt must be a map file"):
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
    "settings", [{"dim": -1}, {"dim": "3"}, {"colour": 1}, {"num_neighbors": 2.5}, {"dim": 10**9}]
)
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
