"""Runs of the command line in tests."""

from lardhm_torch.cli import main


def run(*words):
    assert main([str(word) for word in words]) == 0


def fails(capsys, *words):
    """The one line that a verb prints when it fails."""
    capsys.readouterr()
    assert main([str(word) for word in words]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1
    return err


def room_folder(folder):
    """The folder with a small simulated room, split, and a map of its training half."""
    run("simulate", "--rays", "6000", "-o", folder / "room.npz")
    run("split", folder / "room.npz", "-o", folder / "train.npz", folder / "test.npz")
    run("fit", folder / "train.npz", "-o", folder / "map.pt")
    return folder
