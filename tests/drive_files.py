"""A folder of scans for tests of logs."""

import torch

from lardhm_torch import Scans, save_scans, simulate_room


def save_drive(folder):
    """Save the three scans of a room far from zero, one file each; the folder."""
    room = simulate_room(1500, seed=0)
    shift = torch.tensor([4e5, 5e6, 0.0]).double()
    folder.mkdir()
    for number in range(room.num_scans):
        seen = room.scan_id == number
        place, ends = room.origins[number][None] + shift, room.ends[seen] + shift
        save_scans(Scans(place, ends, None, room.is_return[seen]), folder / f"{number}.npz")
    return folder
