#!/usr/bin/env python3
"""A copy of the drone-tracking-datasets with worse labels, to see what other detectors would do to the tracks.

usage: worse_labels.py DATA_DIR KIND FOLDER      (numpy)

KIND is one of
  half       every second label is missing, at random
  rare       every eighth frame of each camera
  noisy      3 px of white noise
  strangers  every tenth label is somewhere else in the image
  beside     labels wander about the drone by 3 px, for 60 frames at a time
  pose       every camera is turned by 3 mrad per axis, and stands 10 cm off
"""
import json
import pathlib
import shutil
import sys

import numpy as np

RNG = np.random.default_rng(7)


def wander(count, sd, frames):
    """An Ornstein-Uhlenbeck process in pixels, one value a frame."""
    kept, error, errors = np.exp(-1 / frames), np.zeros(2), []
    for _ in range(count):
        error = error * kept + RNG.normal(0, sd * np.sqrt(1 - kept**2), 2)
        errors.append(error)
    return np.array(errors)


def worse(labels, kind):
    """Rows of frame, x, y; 0, 0 is no label."""
    seen = (labels[:, 1:] != 0).any(axis=1)
    if kind == "half":
        labels[RNG.random(len(labels)) < 0.5, 1:] = 0
    elif kind == "rare":
        labels = labels[labels[:, 0] % 8 == 1]
    elif kind == "noisy":
        labels[seen, 1:] += RNG.normal(0, 3, (seen.sum(), 2))
    elif kind == "strangers":
        low, high = labels[seen, 1:].min(axis=0), labels[seen, 1:].max(axis=0)
        other = seen & (RNG.random(len(labels)) < 0.1)
        labels[other, 1:] = low + RNG.random((other.sum(), 2)) * (high - low)
    elif kind == "beside":
        labels[seen, 1:] += wander(len(labels), 3, 60)[seen]
    return labels


def turned(node):
    """Poses that are off, wherever in the file they stand."""
    if isinstance(node, dict) and "R_world_to_cam" in node:
        x, y, z = RNG.normal(0, 3e-3, 3)
        angle = np.sqrt(x * x + y * y + z * z)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        # Rodrigues' formula.
        turn = np.eye(3) + np.sin(angle) / angle * cross + (1 - np.cos(angle)) / angle**2 * cross @ cross
        node["R_world_to_cam"] = (turn @ np.array(node["R_world_to_cam"])).tolist()
        node["centre_enu_m"] = (np.array(node["centre_enu_m"]) + RNG.normal(0, 0.1, 3)).tolist()
    elif isinstance(node, (dict, list)):
        for part in node.values() if isinstance(node, dict) else node:
            turned(part)


def main():
    data, kind, folder = sys.argv[1:]
    if kind not in __doc__.split():
        sys.exit(f"{kind} is none of the kinds:\n{__doc__}")
    shutil.copytree(data, folder)
    for path in sorted(pathlib.Path(folder).glob("dataset*/detections/*.txt")):
        lines = [line for line in path.read_text().splitlines() if line.strip()]
        head = [line for line in lines[:1] if not line.strip()[0].isdigit()]
        labels = worse(np.array([line.split() for line in lines[len(head):]], dtype=float), kind)
        path.write_text("\n".join(head + [f"{n:.6f} {x:.8f} {y:.8f}" for n, x, y in labels]) + "\n")
    if kind == "pose":
        path = pathlib.Path(folder, "poses.json")
        poses = json.loads(path.read_text())
        turned(poses)
        path.write_text(json.dumps(poses))


main()
