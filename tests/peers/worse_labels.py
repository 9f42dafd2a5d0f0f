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
  turned:NAME:MRAD  one camera is turned by so much about a random axis
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


def turn(node, x, y, z):
    """Turns a pose by a rotation vector in its camera's axes."""
    angle = np.sqrt(x * x + y * y + z * z)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    # Rodrigues' formula.
    by = np.eye(3) + np.sin(angle) / angle * cross + (1 - np.cos(angle)) / angle**2 * cross @ cross
    node["R_world_to_cam"] = (by @ np.array(node["R_world_to_cam"])).tolist()


def poses(node, name=None):
    """The names and poses of cameras, wherever in the file they stand."""
    if isinstance(node, dict) and "R_world_to_cam" in node:
        yield node.get("name", name), node
    elif isinstance(node, (dict, list)):
        for name, part in node.items() if isinstance(node, dict) else ((name, part) for part in node):
            yield from poses(part, name)


def displace(file):
    """All poses are off."""
    for _, pose in poses(file):
        turn(pose, *RNG.normal(0, 3e-3, 3))
        pose["centre_enu_m"] = (np.array(pose["centre_enu_m"]) + RNG.normal(0, 0.1, 3)).tolist()


def turn_one(file, name, mrad):
    """One camera is turned by the same rotation in all its poses."""
    axis = RNG.normal(size=3)
    axis *= float(mrad) * 1e-3 / np.linalg.norm(axis)
    of_name = [pose for other, pose in poses(file) if other == name]
    if not of_name:
        sys.exit(f"no camera is called {name}")
    for pose in of_name:
        turn(pose, *axis)


def main():
    data, kind, folder = sys.argv[1:]
    kind, *of = kind.split(":")
    if len(of) != (2 if kind == "turned" else 0):
        sys.exit(f"{sys.argv[2]} is none of the kinds:\n{__doc__}")
    if kind not in __doc__.replace(":", " ").split():
        sys.exit(f"{kind} is none of the kinds:\n{__doc__}")
    shutil.copytree(data, folder)
    for path in sorted(pathlib.Path(folder).glob("dataset*/detections/*.txt")):
        lines = [line for line in path.read_text().splitlines() if line.strip()]
        head = [line for line in lines[:1] if not line.strip()[0].isdigit()]
        labels = worse(np.array([line.split() for line in lines[len(head):]], dtype=float), kind)
        path.write_text("\n".join(head + [f"{n:.6f} {x:.8f} {y:.8f}" for n, x, y in labels]) + "\n")
    if kind in ("pose", "turned"):
        path = pathlib.Path(folder, "poses.json")
        file = json.loads(path.read_text())
        displace(file) if kind == "pose" else turn_one(file, *of)
        path.write_text(json.dumps(file))


main()
