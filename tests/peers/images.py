#!/usr/bin/env python3
"""What one image costs on one core: decoding, finding, following 1, 10 and 50 targets, in 1280x720 and
1920x1080, beside OpenCV in the same run.

usage: images.py [PROGRAM]       (target/release/crossfix)

Needs opencv-contrib-python-headless (PyPI), and /usr/bin/python3 with GStreamer for the H.264. Prints a table in
milliseconds an image, medians.
"""
import csv
import math
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time

import cv2

PROGRAM = os.path.abspath(sys.argv[1] if len(sys.argv) > 1 else "target/release/crossfix")
SECONDS, RATE = 4, 30
# The first second is each one's own: backgrounds are learnt, targets taken up.
SKIPPED = RATE
BOX = 20
# Of the width.
FOCAL = 0.76

TARGET = """
[[targets]]
id = {id}
span_m = 1.2
[targets.path]
kind = "curved"
centre_m = [{x}, 8.0, {z}]
amplitude_m = [6.0, 6.0, 3.0]
period_s = [{period}, 21.0, 13.0]
phase_turns = [{phase}, 0.25, 0.1]
"""
CAMERA = """
seed = 1
duration_s = {seconds}
[[cameras]]
name = "north"
position_m = [0.0, 120.0, 3.0]
look_at_m = [0.0, 0.0, 46.0]
size_px = [{width}, {height}]
focal_px = {focal}
rate_hz = {rate}
exposure_s = 0.004
noise_levels = 2.0
blur_px = 0.6
clock = {{ offset_s = 0.0, drift_ppm = 0.0 }}
"""
ENCODE = """
import sys
import gi
gi.require_version("Gst", "1.0")
from gi.repository import Gst
Gst.init(None)
raw, out, width, height, rate = sys.argv[1:]
line = Gst.parse_launch(
    f"filesrc location={raw} ! rawvideoparse width={width} height={height} format=gray8 framerate={rate}/1"
    " ! videoconvert ! video/x-raw,format=I420 ! x264enc tune=zerolatency speed-preset=veryfast bitrate=6000 key-int-max=30"
    f" ! h264parse ! mp4mux ! filesink location={out}")
line.set_state(Gst.State.PLAYING)
message = line.get_bus().timed_pop_filtered(Gst.CLOCK_TIME_NONE, Gst.MessageType.EOS | Gst.MessageType.ERROR)
line.set_state(Gst.State.NULL)
sys.exit(message.type == Gst.MessageType.ERROR)
"""


def scene(folder, width, height, targets):
    text = CAMERA.format(seconds=SECONDS, width=width, height=height, focal=width * FOCAL, rate=RATE)
    for n in range(targets):
        x, z = place(n)
        text += TARGET.format(id=n + 1, x=x, z=z, period=20 + n % 7, phase=n % 5 / 5)
    path = os.path.join(folder, f"scene{targets}.toml")
    with open(path, "w", encoding="utf-8") as file:
        file.write(text)
    return path


def frames(path):
    """Brightness of every image of a Y4M of brightness alone."""
    with open(path, "rb") as file:
        head = file.readline().decode().split()
        width, height = (int(next(w[1:] for w in head if w[0] == key)) for key in "WH")
        seen = []
        while file.readline():
            seen.append(file.read(width * height))
            file.read(colours(head, width, height))
    return seen


def colours(head, width, height):
    kind = next((word for word in head if word[0] == "C"), "C420")
    return 0 if kind == "Cmono" else 2 * ((width + 1) // 2) * ((height + 1) // 2)


def ours(arguments):
    """Median microseconds that an image's targets took, and processor time of the whole run, s."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    out = subprocess.run([PROGRAM, "track", *arguments], check=True, capture_output=True, text=True).stdout
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    of_image = {int(row["frame"]): float(row["us"]) for row in csv.DictReader(out.splitlines())}
    late = [us for frame, us in of_image.items() if frame >= SKIPPED]
    spent_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return statistics.median(late), sum(of_image.values()) * 1e-6, spent_s


def timed(step, images):
    took = []
    for image in images:
        begun = time.perf_counter()
        step(image)
        took.append(time.perf_counter() - begun)
    return statistics.median(took[SKIPPED:]) * 1e3


def boxes_of(width, height, targets):
    """Where the targets are in the first image: the camera looks south and up."""
    forward = math.hypot(120.0, 43.0)
    boxes = []
    for n in range(targets):
        turn = lambda phase: math.sin(2 * math.pi * phase)
        x = place(n)[0] + 6.0 * turn(n % 5 / 5)
        y = 8.0 + 6.0 * turn(0.25) - 120.0
        z = place(n)[1] + 3.0 * turn(0.1) - 3.0
        depth = (-120.0 * y + 43.0 * z) / forward
        down = (-43.0 * y - 120.0 * z) / forward
        focal = width * FOCAL
        column, row = (width - 1) / 2 - focal * x / depth, (height - 1) / 2 + focal * down / depth
        boxes.append((column - BOX / 2, row - BOX / 2, BOX, BOX))
    return boxes


def place(n):
    """Where a target's path is, east and up, m."""
    return -54 + 12 * (n % 10), 28 + 9 * (n // 10)


def measure(width, height):
    with tempfile.TemporaryDirectory() as folder:
        print(f"{width}x{height}")
        for targets in (1, 10, 50):
            path = scene(folder, width, height, targets)
            subprocess.run([PROGRAM, "simulate", path, "--video", folder], check=True, capture_output=True)
            y4m = os.path.join(folder, "north.y4m")
            images = frames(y4m)
            gray = [memory(image, width, height) for image in images]
            boxes = boxes_of(width, height, targets)
            asked = [word for box in boxes for word in ("--box", ",".join(f"{side:.0f}" for side in box))]
            if targets == 1:
                raw, mp4 = os.path.join(folder, "raw"), os.path.join(folder, "north.mp4")
                with open(raw, "wb") as file:
                    file.writelines(images)
                subprocess.run(["/usr/bin/python3", "-c", ENCODE, raw, mp4, *map(str, (width, height, RATE))], check=True)
                _, steps_s, all_s = ours([mp4, *asked])
                ours_ms = (all_s - steps_s) * 1e3 / len(images)
                video = cv2.VideoCapture(mp4, cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])
                print(f"  H.264 to brightness    {ours_ms:7.2f}   FFmpeg by OpenCV, decoding alone {timed(lambda _: video.grab(), images[1:]):7.2f}")
                found = ours([y4m, "--detect"])[0] * 1e-3
                background = cv2.createBackgroundSubtractorMOG2(detectShadows=False)

                def find(image):
                    cv2.connectedComponentsWithStats(background.apply(image))

                print(f"  finding                {found:7.2f}   MOG2 and components {timed(find, gray):7.2f}")
            followed = ours([y4m, *asked])[0] * 1e-3
            peers = {}
            for name, make in (("KCF", cv2.TrackerKCF_create), ("MOSSE", cv2.legacy.TrackerMOSSE_create)):
                kinds = []
                for box in boxes:
                    kind = make()
                    kind.init(cv2.cvtColor(gray[0], cv2.COLOR_GRAY2BGR), tuple(int(side) for side in box))
                    kinds.append(kind)
                coloured = [cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) for image in gray]
                peers[name] = timed(lambda image, kinds=kinds: [kind.update(image) for kind in kinds], coloured)
            said = "   ".join(f"{name} {took:7.2f}" for name, took in peers.items())
            print(f"  following {len(boxes):3d}          {followed:7.2f}   {said}", flush=True)


def memory(image, width, height):
    import numpy

    return numpy.frombuffer(image, dtype=numpy.uint8).reshape(height, width)


os.sched_setaffinity(0, {1})
cv2.setNumThreads(1)
for size in ((1280, 720), (1920, 1080)):
    measure(*size)
