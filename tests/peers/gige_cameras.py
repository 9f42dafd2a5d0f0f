#!/usr/bin/python3
"""A GigE Vision camera at 127.0.0.1, for tests.

usage: gige_cameras.py aravis            by Aravis (gir1.2-aravis-0.8): its clock is UTC, and a dot goes round
                                         in its image of 512x512: at time t s it is at
                                         (256 + 200 cos t, 256 + 100 sin t), whole pixels
       gige_cameras.py viva [LOST ...]   by viva-genicam (PyPI): its clock counts from when it was made;
                                         packets BLOCK:PACKET are lost

Run it in a network namespace of its own: cameras are asked for by broadcast.
"""
import math
import sys
import time


def aravis():
    import ctypes

    import gi

    gi.require_version("Aravis", "0.8")
    from gi.repository import Aravis

    side = 512
    library = ctypes.CDLL("libaravis-0.8.so.0")
    library.arv_buffer_get_data.restype = ctypes.c_void_p
    library.arv_buffer_get_data.argtypes = [ctypes.c_void_p, ctypes.POINTER(ctypes.c_size_t)]
    library.arv_buffer_get_timestamp.restype = ctypes.c_uint64
    library.arv_buffer_get_timestamp.argtypes = [ctypes.c_void_p]
    filler = ctypes.CFUNCTYPE(
        None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32)

    @filler
    def fill(image, _, exposure, gain, pixels):
        length = ctypes.c_size_t()
        data = library.arv_buffer_get_data(image, ctypes.byref(length))
        ctypes.memset(data, 40, side * side)
        seconds = library.arv_buffer_get_timestamp(image) * 1e-9 or time.time()
        x, y = int(256 + 200 * math.cos(seconds)), int(256 + 100 * math.sin(seconds))
        for row in range(y - 3, y + 4):
            ctypes.memset(data + row * side + x - 3, 230, 7)

    camera = Aravis.GvFakeCamera.new("127.0.0.1", "CF001")
    drawn = camera.get_fake_camera()
    library.arv_fake_camera_set_fill_pattern.argtypes = [ctypes.c_void_p, filler, ctypes.c_void_p]
    library.arv_fake_camera_set_fill_pattern(hash(drawn), fill, None)
    print("up", flush=True)
    time.sleep(3600)


def viva(lost):
    from viva_genicam.testing import FakeGigeCamera

    lost = [tuple(int(number) for number in word.split(":")) for word in lost]
    with FakeGigeCamera(width=640, height=480, fps=25, drop_packets=lost or None):
        print("up", flush=True)
        time.sleep(3600)


if sys.argv[1] == "aravis":
    aravis()
else:
    viva(sys.argv[2:])
